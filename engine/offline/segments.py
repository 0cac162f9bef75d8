"""Stretches of a recording in which patient, couch and camera stay where they are.

Each frame has the movement of the patient against the first measured frame as six numbers: four from the markers on the
couch, which also travel by some millimetres with the breath, and two from the surface, from which the second estimate
takes breathing off. A segment ends with a movement beyond the limits of a session, with a couch or camera that moved,
and with a loss of more than a second.
"""

import math
from dataclasses import dataclass

import numpy as np

from engine.core.clock import US_PER_S
from engine.core.frames import LostReason, Measurement, MeasurementState
from engine.gating.supervision.patient_shift import CORNERS, NODES, MarkersAtReference, Movement

START = "start"
MOVED = "patient_shifted"
SHIFT_MM, TURN_DEG, HEIGHT_MM = 6.0, 3.0, 3.0
"""A movement beyond one of these since the segment began ends it: the defaults of a session."""
STILL_US = 2 * US_PER_S
"""A movement that goes on within this time is the same one."""
LOST_US = US_PER_S
COLUMNS = ("segment", "lost_reason", "shift_x_mm", "shift_y_mm", "height_mm", "tilt_deg", "roll_deg", "turn_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentSummary:
    """One segment: its number from 0, its frames, and why the one before it ended.

    ``measured`` counts its measured frames; ``moved`` are the median of the six numbers over them, None without any.
    """

    segment: int
    cause: str
    first_frame: int
    last_frame: int
    measured: int
    moved: dict[str, float] | None


@dataclass(slots=True, kw_only=True)
class _Open:
    """A segment that goes on."""

    cause: str
    first: int
    last: int
    rows: list[tuple[float, ...]]


class Segments:
    """Follows the measurements of a recording, in order."""

    def __init__(self) -> None:
        self._first: MarkersAtReference | None = None
        self._began: MarkersAtReference | None = None
        self._began_height_mm = 0.0
        self._moved_us = -STILL_US
        self._lost_us: int | None = None
        self._lost_for = LostReason.MARKER_LOST
        self._doubt: LostReason | None = None
        self._segments: list[_Open] = []

    def follow(self, measurement: Measurement) -> list[str]:
        """Return the frame's columns; unknown values are empty."""
        reason = measurement.reason
        cause = self._ended_by(measurement)
        if not self._segments or cause is not None:
            index = measurement.frame_index
            self._segments.append(_Open(cause=cause or START, first=index, last=index, rows=[]))
        segment = self._segments[-1]
        segment.last = measurement.frame_index
        row = self._row(measurement)
        if row is not None:
            segment.rows.append(row)
        numbers = [""] * 6 if row is None else [f"{value:.3f}" if math.isfinite(value) else "" for value in row]
        return [str(len(self._segments) - 1), "" if reason is None else reason.reason.value, *numbers]

    def summary(self) -> tuple[SegmentSummary, ...]:
        """Return the segments so far."""
        return tuple(
            SegmentSummary(
                segment=number,
                cause=one.cause,
                first_frame=one.first,
                last_frame=one.last,
                measured=len(one.rows),
                moved=_medians(one.rows),
            )
            for number, one in enumerate(self._segments)
        )

    def _ended_by(self, measurement: Measurement) -> str | None:
        """Return what ends the segment before this frame; None where nothing does."""
        if measurement.state is not MeasurementState.MEASURING:
            if measurement.lost is not None:
                self._lost_us = measurement.timestamp_us if self._lost_us is None else self._lost_us
                self._lost_for = measurement.lost.reason
            return None
        lost_us, self._lost_us = self._lost_us, None
        before, self._doubt = self._doubt, None if measurement.doubt is None else measurement.doubt.reason
        if lost_us is not None and measurement.timestamp_us - lost_us > LOST_US:
            self._begin(measurement)
            return (self._doubt or self._lost_for).value
        if before is not self._doubt:
            self._begin(measurement)
            return (self._doubt or before or LostReason.CAMERA_MOVED).value
        moved = self._movement(self._began, measurement)
        if moved is None:
            return None
        height_mm = 0.0 if measurement.position is None else measurement.position.height_mm - self._began_height_mm
        if moved.shift_mm <= SHIFT_MM and moved.turn_deg <= TURN_DEG and abs(height_mm) <= HEIGHT_MM:
            return None
        self._begin(measurement)
        is_going_on = measurement.timestamp_us - self._moved_us <= STILL_US
        self._moved_us = measurement.timestamp_us
        return None if is_going_on else MOVED

    def _begin(self, measurement: Measurement) -> None:
        """Measure the next movement from here."""
        self._began = None
        self._movement(None, measurement)
        self._began_height_mm = 0.0 if measurement.position is None else measurement.position.height_mm

    def _movement(self, since: MarkersAtReference | None, measurement: Measurement) -> Movement | None:
        motion = measurement.motion
        if motion is None or len(motion.surface_mm) != NODES:
            return None
        markers_mm = np.asarray(motion.surface_mm[list(CORNERS)], dtype=np.float64)
        if self._first is None:
            self._first = MarkersAtReference(markers_mm)
        if self._began is None:
            self._began = MarkersAtReference(markers_mm)
        return None if since is None else since.movement(markers_mm)

    def _row(self, measurement: Measurement) -> tuple[float, ...] | None:
        if measurement.motion is None:
            return None
        moved = self._movement(self._first, measurement)
        position = measurement.position
        on_couch = (math.nan,) * 3 if moved is None else (moved.across_mm, moved.along_mm, moved.on_couch_deg)
        surface = (math.nan,) * 3 if position is None else (position.height_mm, position.tilt_deg, position.roll_deg)
        return (*on_couch[:2], *surface, on_couch[2])


def _medians(rows: list[tuple[float, ...]]) -> dict[str, float] | None:
    """Return the median of each number over the frames that have it, by its column's name."""
    if not rows:
        return None
    of_columns = zip(COLUMNS[2:], np.array(rows, dtype=np.float64).T, strict=True)
    return {name: round(float(np.nanmedian(of)), 3) for name, of in of_columns if np.isfinite(of).any()}
