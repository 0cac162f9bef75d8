"""Movement of the patient as a whole since the reference, by the four markers and by the region's surface.

Breathing lifts the markers towards the camera, and tilts their plane about the axis across the body where the abdomen
rises more than the thorax; both are ignored. Breathing does not move all four along the couch, rotate them on it, or
roll them about the body's long axis. Height and tilt are those of the surface, from which the second estimate takes
breathing off (:mod:`engine.motion.cross_check`).

Stickers on clothing slide over the skin with each breath: tissue then moves through the region, and the motion of a
part of it is wrong by about as much. So their travel within a breath is measured, and bounded for windows on parts.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from engine.core.frames import NODE_COLUMNS, NODE_ROWS, BodyPosition, FloatArray, Motion
from engine.core.gate_state import HoldReason
from engine.core.sentences import say
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits

SPAN_US = 500_000
TRAVEL_US = 10_000_000
"""Two breaths: their ends of exhale and inhale are among the last ten seconds."""
NODES = NODE_ROWS * NODE_COLUMNS
CORNERS = (0, NODE_COLUMNS - 1, NODES - 1, NODES - NODE_COLUMNS)
"""Nodes of the surface at the markers: superior right, superior left, inferior left, inferior right."""


class Movement(NamedTuple):
    """Shift along the couch [mm]; the larger of the rotations on the couch and about the body's long axis [deg].

    ``across_mm`` and ``along_mm`` are the shift across and along the body, ``on_couch_deg`` the rotation on the couch.
    """

    shift_mm: float
    turn_deg: float
    across_mm: float = 0.0
    along_mm: float = 0.0
    on_couch_deg: float = 0.0


class _Span(NamedTuple):
    """Where the markers were within half a second [mm]."""

    begun_us: int
    left_mm: float
    right_mm: float
    superior_mm: float
    inferior_mm: float


class PatientShift:
    """Compares the markers with their positions at the reference; owned by the engine thread.

    Attributes
    ----------
    movement
        That of the newest frame; None where it was not measured, or there is no reference.
    """

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self.movement: Movement | None = None
        self._travel: deque[_Span] = deque()
        self._at_reference: MarkersAtReference | None = None

    def reset(self) -> None:
        """Use the next measured frame as the position at the reference."""
        self._at_reference = None
        self.movement = None
        self._travel.clear()

    @property
    def travel_mm(self) -> float | None:
        """How far the markers have gone along the couch within the last ten seconds [mm]; None where not known."""
        if self.movement is None:
            return None
        spans = self._travel
        across_mm = max(one.right_mm for one in spans) - min(one.left_mm for one in spans)
        along_mm = max(one.inferior_mm for one in spans) - min(one.superior_mm for one in spans)
        return math.hypot(across_mm, along_mm)

    def check(
        self,
        motion: Motion | None,
        *,
        has_reference: bool,
        position: BodyPosition | None = None,
        timestamp_us: int = 0,
        is_on_part: bool = False,
    ) -> Interruption | None:
        """Return the hold for a movement beyond the limits; a new model with the same reference resets nothing.

        Parameters
        ----------
        position
            Rigid movement of the surface since the reference; None where it is unknown.
        timestamp_us
            Device time of the frame.
        is_on_part
            Whether the window is on a part of the region: then the markers' travel is bounded too.
        """
        self.movement = None
        if not has_reference:
            self.reset()
            return None
        if motion is None or len(motion.surface_mm) != NODES:
            return None  # not measured: the frame itself holds
        markers_mm = np.asarray(motion.surface_mm[list(CORNERS)], dtype=np.float64)
        if self._at_reference is None:
            self._at_reference = MarkersAtReference(markers_mm)
            return None
        self.movement = self._at_reference.movement(markers_mm)
        self._follow(self.movement, timestamp_us)
        shifted = self._hold_for(self.movement) or (self._hold_for_travel() if is_on_part else None)
        return shifted or (None if position is None else self._hold_for_surface(position))

    def _follow(self, moved: Movement, timestamp_us: int) -> None:
        spans, across_mm, along_mm = self._travel, moved.across_mm, moved.along_mm
        while spans and not 0 <= timestamp_us - spans[0].begun_us <= TRAVEL_US:
            spans.popleft()
        if not spans or timestamp_us - spans[-1].begun_us >= SPAN_US:
            spans.append(_Span(timestamp_us, across_mm, across_mm, along_mm, along_mm))
            return
        last = spans[-1]
        spans[-1] = _Span(
            last.begun_us,
            min(last.left_mm, across_mm),
            max(last.right_mm, across_mm),
            min(last.superior_mm, along_mm),
            max(last.inferior_mm, along_mm),
        )

    def _hold_for_travel(self) -> Interruption | None:
        travel_mm, most_mm = self.travel_mm, self._limits.max_marker_travel_mm
        if travel_mm is None or travel_mm <= most_mm:
            return None
        detail = say(
            "the markers slide by {travel_mm:.1f} mm with the breath, "
            "{most_mm:g} allowed for a window on a part: put them on skin",
            travel_mm=travel_mm,
            most_mm=most_mm,
        )
        return Interruption(HoldReason.PATIENT_SHIFTED, detail)

    def _hold_for(self, moved: Movement) -> Interruption | None:
        limits = self._limits
        if not moved.shift_mm <= limits.max_shift_mm:
            detail = say(
                "moved {shift_mm:.1f} mm along the couch, {max_shift_mm:g} allowed",
                shift_mm=moved.shift_mm,
                max_shift_mm=limits.max_shift_mm,
            )
            return Interruption(HoldReason.PATIENT_SHIFTED, detail)
        if not moved.turn_deg <= limits.max_turn_deg:
            detail = say(
                "rotated by {turn_deg:.1f} degrees, {max_turn_deg:g} allowed",
                turn_deg=moved.turn_deg,
                max_turn_deg=limits.max_turn_deg,
            )
            return Interruption(HoldReason.PATIENT_SHIFTED, detail)
        return None

    def _hold_for_surface(self, position: BodyPosition) -> Interruption | None:
        limits = self._limits
        if not abs(position.height_mm) <= limits.max_height_mm:
            way = say("lowered") if position.height_mm < 0.0 else say("raised")
            detail = say(
                "{way} by {height_mm:.1f} mm, {max_height_mm:g} allowed",
                way=way,
                height_mm=abs(position.height_mm),
                max_height_mm=limits.max_height_mm,
            )
            return Interruption(HoldReason.PATIENT_SHIFTED, detail)
        turn_deg = max(abs(position.tilt_deg), abs(position.roll_deg))
        if not turn_deg <= limits.max_turn_deg:
            detail = say(
                "tilted by {turn_deg:.1f} degrees, {max_turn_deg:g} allowed",
                turn_deg=turn_deg,
                max_turn_deg=limits.max_turn_deg,
            )
            return Interruption(HoldReason.PATIENT_SHIFTED, detail)
        return None


class MarkersAtReference:
    """Positions of the four markers at the reference, and their plane, in which later movements are measured.

    Parameters
    ----------
    markers_mm
        Superior right, superior left, inferior left, inferior right, in the depth camera's frame [mm], shape (4, 3).
    """

    def __init__(self, markers_mm: FloatArray) -> None:
        self._axes = _body_axes(markers_mm)
        self._middle_mm = markers_mm.mean(axis=0)
        self._before = self._seen(markers_mm)

    def movement(self, now_mm: FloatArray) -> Movement:
        """Return the movement since; the shift is NaN where a marker is not finite."""
        before, now = self._before, self._seen(now_mm)
        across_mm, along_mm, _ = (sum(axis) / len(axis) for axis in zip(*now, strict=True))
        cross = dot = 0.0
        for (x0, y0, _), (x, y, _) in zip(before, now, strict=True):
            # The positions at the reference are counted from their own middle: a shift adds nothing to either sum.
            cross += x0 * y - y0 * x
            dot += x0 * x + y0 * y
        right, left = (0, 3), (1, 2)
        # At the reference both sides are equally high, by the choice of the plane.
        left_over_right_mm = sum(now[one][2] for one in left) - sum(now[one][2] for one in right)
        width_mm = sum(before[one][0] for one in left) - sum(before[one][0] for one in right)
        turns_rad = (math.atan2(cross, dot), math.atan2(left_over_right_mm, width_mm))
        turn_deg = max(abs(math.degrees(turn)) for turn in turns_rad)
        return Movement(
            math.hypot(across_mm, along_mm), turn_deg, across_mm, along_mm, on_couch_deg=math.degrees(turns_rad[0])
        )

    def _seen(self, markers_mm: FloatArray) -> list[list[float]]:
        """Coordinates across the body, along it, and out of the plane, from the centre at the reference [mm]."""
        seen: list[list[float]] = ((markers_mm - self._middle_mm) @ self._axes).tolist()
        return seen


def _body_axes(markers_mm: FloatArray) -> FloatArray:
    """Return unit vectors across the body, along it, and out of the markers' plane, as columns, shape (3, 3)."""
    superior_right, superior_left, inferior_left, inferior_right = markers_mm
    along = inferior_left + inferior_right - superior_left - superior_right
    across = superior_left + inferior_left - superior_right - inferior_right
    along = along / np.linalg.norm(along)
    normal = np.cross(across, along)
    normal = normal / np.linalg.norm(normal)
    return np.stack([np.cross(along, normal), along, normal], axis=1)
