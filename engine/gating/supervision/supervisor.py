"""Supervision over several frames, in addition to the checks of each one.

The holds found at the newest frame are part of every decision until the next frame.
"""

from collections import deque
from collections.abc import Iterable

from engine.core.clock import NS_PER_MS, NS_PER_S
from engine.core.frames import LostReason, Measurement, RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.learning_events import LearningEvent
from engine.core.motion_model import MotionModel
from engine.core.signals import is_wide
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits
from engine.gating.supervision.baseline import Baseline
from engine.gating.supervision.checks import Checks, CheckState
from engine.gating.supervision.exhale_shape import ExhaleShape
from engine.gating.supervision.model_age import ModelAge
from engine.gating.supervision.patient_shift import Movement, PatientShift
from engine.gating.windows import GateWindow


class FrameSupervisor:
    """Checks every frame once; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._rate = _FrameRate(limits.min_fps)
        self._age = ModelAge(limits)
        self._shift = PatientShift(limits)
        self._baseline = Baseline(limits)
        self._checks = Checks(limits)
        self._exhale_shape = ExhaleShape(limits)
        self._old_pictures = _OldPictures(limits.max_silence_ms)
        self._order = _DeviceOrder()

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
        found = (
            self._checks.check(measurement, has_reference=has_reference),
            self._rate.check(frame.received_ns),
            self._exhale_shape.check(measurement, has_reference=has_reference),
            self._baseline.check(measurement, window, has_reference=has_reference),
            self._age.check(model, notices, frame.received_ns),
            self._shift.check(
                measurement.motion,
                has_reference=has_reference,
                position=measurement.position,
                timestamp_us=measurement.timestamp_us,
                is_on_part=not all(map(is_wide, window.choices)),
            ),
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
        detail = f"{frames} frames in the last second, {self._min_fps:g} needed"
        return Interruption(HoldReason.FRAME_RATE_LOW, detail)


class _OldPictures:
    """A camera that goes on delivering old pictures is as silent as one that delivers none: a fault."""

    def __init__(self, max_silence_ms: float) -> None:
        self._max_silence_ms = max_silence_ms
        self._last_new_ns: int | None = None

    def check(self, measurement: Measurement) -> Interruption | None:
        lost = measurement.lost
        if self._last_new_ns is None or lost is None or lost.reason is not LostReason.FRAME_FROZEN:
            self._last_new_ns = measurement.received_ns
            return None
        old_ms = (measurement.received_ns - self._last_new_ns) / NS_PER_MS
        if old_ms <= self._max_silence_ms:
            return None
        return Interruption(HoldReason.FRAME_TIMEOUT, f"old pictures for {old_ms:.0f} ms: {lost.detail}")


class _DeviceOrder:
    """Compares the camera's own frame numbers: old pictures may come with new times."""

    def __init__(self) -> None:
        self._last: int | None = None

    def check(self, device_index: int) -> Interruption | None:
        last, self._last = self._last, device_index
        if last is None or device_index > last:
            return None
        return Interruption(HoldReason.CLOCK_BACKWARDS, f"the camera's frame {device_index} after its frame {last}")
