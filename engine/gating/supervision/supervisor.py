"""Supervision over several frames, in addition to the checks of each one.

The holds found at the newest frame are part of every decision until the next frame.
"""

import math
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from engine.core.clock import NS_PER_MS, NS_PER_S
from engine.core.frames import NODE_COLUMNS, FloatArray, LostReason, Measurement, RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningEvent, LearningEventKind
from engine.core.motion_model import MotionModel
from engine.core.sentences import listed, say
from engine.core.warmth import Warmth
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits
from engine.gating.supervision.checks import Checks, CheckState
from engine.gating.supervision.patient_shift import NODES, RETURNED, Baseline, Movement, PatientShift
from engine.gating.windows import GateWindow

REDISTRIBUTED_SHARE = 0.3
"""Allowed shift between thorax and abdomen, root mean square, as a share of the bound of the level: one half of the
region that rises evenly by h mm is a shift of about 0.6 h."""
KEPT_US = 135_000_000
"""An end of exhale is known when the next inhale has begun: after the longest breath and the longest breath hold that a
site may allow, of 120 s."""


NOT_JUDGED = say("the shape of the chest at the end of exhale cannot be compared: the breath pauses for too long")
NS_PER_MIN = 60 * NS_PER_S
MAX_OLD_MS = 100.0
"""Limit of the total time of repeated pictures, since the session or the last such fault (AAPM TG-142: 100 ms)."""
MAX_OLD_IN_PART_MS = 50.0
"""The same where pictures are old in part: their parts are of two moments, so that no motion between them is right."""


# The shape of the chest at the end of exhale: a slow change of one part of it passes for breathing in every frame.
#
# Cloth that swells, a belly that fills, or a growing error of the depth over half of the region is explained by a
# tilt of the body, or by a shift between thorax and abdomen, which both come and go within a breath. At the end of
# exhale neither is left of a breath: there they are drifts, and bounded as the level is
# (:mod:`engine.gating.supervision.patient_shift`).
class _Shape(NamedTuple):
    """Tilt about the axis across the body [deg] and redistribution [mm], of one frame."""

    timestamp_us: int
    tilt_deg: float
    redistributed_mm: float


class ExhaleShape:
    """Compares the ends of exhale with the reference; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._max_mm = limits.max_baseline_drift_mm
        self._kept: deque[_Shape] = deque()
        self._since_us: int | None = None
        self._exhale_us: int | None = None
        self._drifted: Interruption | None = None

    def reset(self) -> None:
        """Accept the patient's present shape: the reference was set."""
        self._kept.clear()
        self._since_us = self._exhale_us = self._drifted = None

    def check(self, measurement: Measurement, *, has_reference: bool) -> Interruption | None:
        """Return the hold for a shape that has drifted; it stands until the next end of exhale."""
        if not has_reference:
            self.reset()
        motion, position, now_us = measurement.motion, measurement.position, measurement.timestamp_us
        if motion is None:
            return None  # the frame itself holds
        while self._kept and not 0 <= now_us - self._kept[0].timestamp_us <= KEPT_US:
            self._kept.popleft()
        if self._since_us is None:
            self._since_us = now_us
        if position is not None:
            self._kept.append(_Shape(now_us, position.tilt_deg, position.redistributed_mm))
        exhale_us = measurement.breaths[0].exhale_us if measurement.breaths else None
        if exhale_us is not None and exhale_us != self._exhale_us:
            self._exhale_us = exhale_us
            if exhale_us >= self._since_us:
                self._drifted = self._judge(exhale_us, _half_length_mm(motion.surface_mm))
        return self._drifted

    def _judge(self, exhale_us: int, half_length_mm: float) -> Interruption | None:
        """Return the hold of an end of exhale since the reference, or for one that cannot be compared any more."""
        found = next((one for one in self._kept if one.timestamp_us >= exhale_us), None)
        if not self._kept:
            return None  # the surface's position is not known at all, which `Checks` says
        if found is None or self._kept[0].timestamp_us > exhale_us:
            return Interruption(HoldReason.CHECK_MISSING, NOT_JUDGED)
        return self._hold(found, half_length_mm)

    def _hold(self, shape: _Shape, half_length_mm: float) -> Interruption | None:
        ends_mm = abs(math.tan(math.radians(shape.tilt_deg))) * half_length_mm
        share = RETURNED if self._drifted is not None else 1.0
        allowed_mm = share * self._max_mm
        if not ends_mm <= allowed_mm:
            detail = say(
                "at the end of exhale the body is tilted: {ends_mm:.1f} mm at the region's ends", ends_mm=ends_mm
            )
        elif not shape.redistributed_mm <= REDISTRIBUTED_SHARE * allowed_mm:
            allowed_mm *= REDISTRIBUTED_SHARE
            detail = say(
                "at the end of exhale thorax and abdomen are shifted by {redistributed_mm:.1f} mm",
                redistributed_mm=shape.redistributed_mm,
            )
        else:
            return None
        text = say(
            "{detail} against the reference, {allowed_mm:.1f} allowed: look at the patient, set the reference again",
            detail=detail,
            allowed_mm=allowed_mm,
        )
        return Interruption(HoldReason.BASELINE_DRIFTED, text)


def _half_length_mm(surface_mm: FloatArray) -> float:
    """Return the distance of the region's middle from its superior end; 0 where the surface is not known."""
    return 0.5 * float(np.linalg.norm(surface_mm[0] - surface_mm[-NODE_COLUMNS])) if len(surface_mm) == NODES else 0.0


# Age of the model in use, by the host's clock, since it was trained or compared with the patient.
class ModelAge:
    """Follows the learning events; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._model: MotionModel | None = None
        self._since_ns = 0
        self._ready_ns: int | None = None

    def check(self, model: MotionModel | None, notices: Iterable[LearningEvent], now_ns: int) -> Interruption | None:
        """Return the hold for a model that is too old; the age of one that waited counts from its training."""
        if model is not self._model:
            self._model, self._since_ns = model, now_ns
        for notice in notices:
            self._note(notice, now_ns)
        age_min = (now_ns - self._since_ns) / NS_PER_MIN
        if model is None or age_min <= self._limits.max_model_age_min:
            return None
        detail = say(
            "trained or compared {age_min:.0f} min ago, {max_model_age_min:g} allowed",
            age_min=age_min,
            max_model_age_min=self._limits.max_model_age_min,
        )
        return Interruption(HoldReason.MODEL_OLD, detail)

    def _note(self, notice: LearningEvent, now_ns: int) -> None:
        match notice.kind:
            case LearningEventKind.READY:
                self._ready_ns = now_ns
            case LearningEventKind.SWAPPED:
                self._since_ns = now_ns if self._ready_ns is None else self._ready_ns
                self._ready_ns = None
            case LearningEventKind.COMPARED if notice.figures.get("is_accepted"):
                self._since_ns = now_ns


class WarmUp:
    """Holds until the camera is warm, counted by its frames; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._warmth = Warmth(limits.warm_up_s, limits.cold_share)

    def begin(self, cold_share: float) -> None:
        """Begin with a camera that is this cold."""
        self._warmth.cold_share = cold_share if self._warmth.warm_up_s > 0.0 else 0.0

    @property
    def is_cold(self) -> bool:
        """Whether the readings still drift."""
        return self._warmth.left_s > 0.0

    def check(self, received_ns: int) -> Interruption | None:
        """Return the hold for a camera that is not warm yet."""
        self._warmth.frame(received_ns)
        left_min = math.ceil(self._warmth.left_s / 60.0)
        if not left_min:
            return None
        detail = say("readings drift for {left_min} more minutes: let the camera run", left_min=left_min)
        return Interruption(HoldReason.CAMERA_WARMING, detail)


class FrameSupervisor:
    """Checks every frame once; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._rate = _FrameRate(limits.min_fps)
        self._age = ModelAge(limits)
        self._warm_up = WarmUp(limits)
        self._shift = PatientShift(limits)
        self._baseline = Baseline(limits)
        self._checks = Checks(limits)
        self._exhale_shape = ExhaleShape(limits)
        self._old_pictures = _OldPictures()
        self._order = _DeviceOrder()
        self._is_reference_cold = False

    def begin(self, cold_share: float | None) -> None:
        """Begin with a camera that was opened as cold as this; None where it is not known."""
        if cold_share is not None:
            self._warm_up.begin(cold_share)

    def take_warmed(self) -> bool:
        """Return, once, that the camera has become warm since the reference was set with it cold."""
        is_due = self._is_reference_cold and not self._warm_up.is_cold
        self._is_reference_cold = self._is_reference_cold and not is_due
        return is_due

    def check(
        self,
        frame: RgbdFrame,
        measurement: Measurement,
        *,
        window: GateWindow,
        model: MotionModel | None,
        has_reference: bool,
        notices: Iterable[LearningEvent],
    ) -> tuple[Interruption, ...]:
        """Return the holds, the most important last: that one is displayed.

        ``window`` is the one that is in use.
        """
        shifted = self._shift.check(
            measurement.motion,
            has_reference=has_reference,
            position=measurement.position,
            timestamp_us=measurement.timestamp_us,
            is_on_part=not all(choice.is_wide for choice in window.choices),
        )
        found = (
            self._warm_up.check(frame.received_ns),
            self._checks.check(measurement, has_reference=has_reference, has_markers=self._shift.movement is not None),
            self._rate.check(frame.received_ns),
            self._exhale_shape.check(measurement, has_reference=has_reference),
            self._baseline.check(measurement, window, has_reference=has_reference),
            self._age.check(model, notices, frame.received_ns),
            shifted,
            self._old_pictures.check(measurement),
            self._order.check(frame.device_index),
        )
        return tuple(one for one in found if one is not None)

    @property
    def movement(self) -> Movement | None:
        """Movement of the markers since the reference, in the newest frame; None where it is not known."""
        return self._shift.movement

    @property
    def marker_travel_mm(self) -> float | None:
        """How far the markers slide with the breath [mm]; None where it is not known."""
        return self._shift.travel_mm

    @property
    def checks(self) -> tuple[CheckState, ...]:
        """Which checks of the measurement work; empty without a reference."""
        return self._checks.states

    def reset_position(self) -> None:
        """Measure later shifts and drifts from the patient's next position: the reference was set."""
        self._is_reference_cold = self._warm_up.is_cold
        self._checks.reset()
        self._exhale_shape.reset()
        self._shift.reset()
        self._baseline.reset()


class _FrameRate:
    """Counts the frames of the last second; no hold before one second has passed."""

    def __init__(self, min_fps: float) -> None:
        self._min_fps = min_fps
        self._first_ns: int | None = None
        self._received_ns: deque[int] = deque()

    def check(self, received_ns: int) -> Interruption | None:
        if self._first_ns is None:
            self._first_ns = received_ns
        self._received_ns.append(received_ns)
        while received_ns - self._received_ns[0] >= NS_PER_S:
            self._received_ns.popleft()
        frames = len(self._received_ns)
        if received_ns - self._first_ns < NS_PER_S or frames >= self._min_fps:
            return None
        detail = say("{frames} frames in the last second, {min_fps:g} needed", frames=frames, min_fps=self._min_fps)
        return Interruption(HoldReason.FRAME_RATE_LOW, detail)


class _OldPictures:
    """Adds up the time of repeated pictures: later pictures may be older than their time stamps by that sum.

    A camera or driver whose queue grows repeats pictures and then delivers new ones late, each with the time of
    delivery. Nothing in a later picture shows that it has caught up, so the time is never forgotten. Of a part that
    lags, too, only the first pictures repeat what was seen.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._old_ns = 0
        self._max_old_ms = MAX_OLD_MS

    def check(self, measurement: Measurement) -> Interruption | None:
        last_ns, self._last_ns = self._last_ns, measurement.received_ns
        lost = measurement.lost
        if last_ns is None or lost is None or lost.reason not in {LostReason.FRAME_FROZEN, LostReason.FRAME_TORN}:
            if self._old_ns > self._max_old_ms * NS_PER_MS:
                # The fault has latched; a person who acknowledges it looks at the camera.
                self._old_ns, self._max_old_ms = 0, MAX_OLD_MS
            return None
        if lost.reason is LostReason.FRAME_TORN:
            self._max_old_ms = MAX_OLD_IN_PART_MS
        self._old_ns += measurement.received_ns - last_ns
        old_ms = self._old_ns / NS_PER_MS
        if old_ms <= self._max_old_ms:
            return None
        detail = say(
            "pictures were repeated for {old_ms:.0f} ms, {max_old_ms:g} allowed: later ones may be as late",
            old_ms=old_ms,
            max_old_ms=self._max_old_ms,
        )
        return Interruption(HoldReason.FRAME_STALE, listed("; ", (detail, lost.detail)))


class _DeviceOrder:
    """Compares the camera's own frame numbers: old pictures may come with new times."""

    def __init__(self) -> None:
        self._last: int | None = None

    def check(self, device_index: int) -> Interruption | None:
        last, self._last = self._last, device_index
        if last is None or device_index > last:
            return None
        return Interruption(
            HoldReason.CLOCK_BACKWARDS,
            say("the camera's frame {device_index} after its frame {last}", device_index=device_index, last=last),
        )
