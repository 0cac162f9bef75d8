"""Whether the patient lies as at the reference: movement as a whole, and the level at which the patient breathes.

Movement is measured by the four markers and by the region's surface. Breathing lifts the markers towards the camera,
and tilts their plane about the axis across the body where the abdomen rises more than the thorax; both are ignored.
Breathing does not move all four along the couch, rotate them on it, or roll them about the body's long axis. Height
and tilt are those of the surface, from which the second estimate takes breathing off
(:mod:`engine.motion.cross_check`).

Stickers on clothing slide over the skin with each breath: tissue then moves through the region, and the motion of a
part of it is wrong by about as much. So their travel within a breath is measured, and bounded for windows on parts.

An amplitude window has its meaning only while the end of exhale stays: a patient who lies some millimetres lower meets
the same window at another moment of the breath. So the last end of exhale is compared with where it was when the
reference was set, or where a person has confirmed it; it is known when the next inhale has begun. After more than a
second without a measurement, or a jump of a gated signal, the patient may lie elsewhere: before the beam may be on,
the surface's height without breathing has to be within the bound, or an end of exhale has to be seen. An expiration
hold is at the end of exhale itself; inspiration holds and phases have their own rules.
"""

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from engine.core.breath import Breath, SignalChoice
from engine.core.clock import US_PER_S
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, BodyPosition, FloatArray, Measurement, Motion
from engine.core.gate_state import HoldReason
from engine.core.sentences import say
from engine.gating.frame_checks import MAX_JUMP_FRAMES
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, Condition, GateWindow, HoldKind

SPAN_US = 500_000

TRAVEL_US = 10_000_000
"""Two breaths: their ends of exhale and inhale are among the last ten seconds."""

NODES = NODE_ROWS * NODE_COLUMNS

CORNERS = (0, NODE_COLUMNS - 1, NODES - 1, NODES - NODE_COLUMNS)
"""Nodes of the surface at the markers: superior right, superior left, inferior left, inferior right."""

HALF = 0.5

BREATH_SHARE = 1.0 / 3.0

RETURNED = 0.9
"""A drift ends at this share of its bound."""

LONGEST_UNMEASURED_US = 1_000_000


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


class _Level(NamedTuple):
    """A gated signal's end of exhale, and the largest drift of it that does not hold."""

    choice: SignalChoice
    breath: Breath
    bound: float


class Baseline:
    """Compares the ends of exhale with those at the reference; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._max_mm = limits.max_baseline_drift_mm
        self._drifted: dict[SignalChoice, Interruption] = {}
        self._measured_us: int | None = None
        self._unknown_since_us: int | None = None
        self._why_unknown = ""
        self._max_jump_mm = limits.max_jump_mm
        self._before: tuple[int, dict[SignalChoice, float]] | None = None

    def reset(self) -> None:
        """Accept the patient's present level: the reference was set."""
        self._drifted.clear()
        self._unknown_since_us = self._before = None

    def check(self, measurement: Measurement, window: GateWindow, *, has_reference: bool = True) -> Interruption | None:
        """Return the hold for a level that is elsewhere, or not known since the last gap."""
        if not has_reference:
            self.reset()
        if measurement.motion is None:
            return None  # the frame itself holds
        now_us = measurement.timestamp_us
        before_us, self._measured_us = self._measured_us, now_us
        if before_us is not None and not 0 <= now_us - before_us <= LONGEST_UNMEASURED_US:
            gap_s = abs(now_us - before_us) / US_PER_S
            self._unknown_since_us, self._why_unknown = now_us, say("not measured for {gap_s:.1f} s", gap_s=gap_s)
        levels = list(_levels(measurement, window, self._max_mm))
        self._note_jump(measurement.motion, measurement.frame_index, now_us, levels)
        if self._unknown_since_us is not None and levels:
            if not all(_is_known(one, measurement, self._unknown_since_us) for one in levels):
                detail = say(
                    "{why_unknown}, and the patient may lie elsewhere: "
                    "an end of exhale has to be seen, or set the reference again",
                    why_unknown=self._why_unknown,
                )
                return Interruption(HoldReason.BASELINE_DRIFTED, detail)
            self._unknown_since_us = None
        return next((hold for one in levels if (hold := self._drift(one)) is not None), None)

    def _note_jump(self, motion: Motion, frame_index: int, now_us: int, levels: list[_Level]) -> None:
        """Forget the level where a gated signal has jumped since the last measured frame."""
        signals = {one.choice: one.choice.value_in(motion) for one in levels}
        before, self._before = self._before, (frame_index, signals)
        if before is None or before[1].keys() != signals.keys():
            return
        frames = min(max(frame_index - before[0], 1), MAX_JUMP_FRAMES)
        steps_mm = [abs(now - before[1][choice]) / choice.per_mm for choice, now in signals.items()]
        if not max(steps_mm, default=0.0) <= self._max_jump_mm * frames:
            self._unknown_since_us, self._why_unknown = (
                now_us,
                say("jumped by {step_mm:.1f} mm", step_mm=max(steps_mm)),
            )

    def _drift(self, level: _Level) -> Interruption | None:
        choice, drift = level.choice, level.breath.exhale_drift
        allowed = level.bound * (RETURNED if choice in self._drifted else 1.0)
        if drift is None:
            return self._drifted.get(choice)  # a cough hides the end of exhale: nothing has come back
        if abs(drift) <= allowed:
            self._drifted.pop(choice, None)
            return None
        way = say("towards") if drift > 0.0 else say("away from")
        detail = say(
            "{label}: the end of exhale is {drift:.2g} {unit} {way} the camera, "
            "{allowed:.2g} allowed: correct the baseline, or set the reference again",
            label=choice.label,
            drift=abs(drift),
            unit=choice.unit,
            way=way,
            allowed=allowed,
        )
        self._drifted[choice] = Interruption(HoldReason.BASELINE_DRIFTED, detail)
        return self._drifted[choice]


def _is_known(level: _Level, measurement: Measurement, since_us: int) -> bool:
    """Return whether the level is known since a gap: by the surface's height, or by an end of exhale."""
    position, exhale_us = measurement.position, level.breath.exhale_us
    is_as_high = (
        position is not None
        and position.measured_us >= since_us
        and abs(position.height_mm) <= level.bound / level.choice.per_mm
    )
    return is_as_high or (exhale_us is not None and exhale_us >= since_us)


def _edges_at_exhale(leaf: Condition) -> AmplitudeWindow | None:
    """Return the edges that have their meaning only while the end of exhale stays."""
    if isinstance(leaf, BreathHoldWindow):
        return leaf.level if leaf.kind is HoldKind.EXPIRATION else None
    return leaf if isinstance(leaf, AmplitudeWindow) else None


def _levels(measurement: Measurement, window: GateWindow, max_mm: float) -> Iterator[_Level]:
    """Yield the levels of the amplitude conditions and expiration holds whose breath is followed."""
    breaths = {breath.signal: breath for breath in measurement.breaths}
    for leaf in map(_edges_at_exhale, window.leaves):
        breath = None if leaf is None else breaths.get(leaf.choice)
        if leaf is not None and breath is not None:
            bounds = [max_mm * leaf.choice.per_mm]
            if not leaf.needs_ranges:
                bounds.append(HALF * (leaf.upper - leaf.lower))
            if breath.amplitude is not None:
                bounds.append(BREATH_SHARE * breath.amplitude)
            yield _Level(leaf.choice, breath, min(bounds))
