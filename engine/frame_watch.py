"""What stands against the beam for as long as frames show it, beside whether each frame may be trusted.

What was found at the newest frame is part of every decision until the next one, whatever that decision is about.
"""

from collections import deque
from collections.abc import Iterable

from engine.clock import NS_PER_S
from engine.frames import Measurement, RgbdFrame
from engine.limits import GateLimits
from engine.model import MotionModel
from engine.model_age import ModelAge
from engine.notices import LearningNotice
from engine.patient_shift import PatientShift
from engine.permits import HoldReason
from engine.repeats import Repeats
from engine.stages.gate import Interruption


class FrameWatch:
    """Looks at every frame once; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._rate = _FrameRate(limits.min_fps)
        self._age = ModelAge(limits)
        self._shift = PatientShift(limits)
        self._repeats = Repeats(limits)
        self._order = _DeviceOrder()

    def look(
        self,
        frame: RgbdFrame,
        measurement: Measurement,
        *,
        model: MotionModel | None,
        has_zero: bool,
        notices: Iterable[LearningNotice],
    ) -> tuple[Interruption, ...]:
        """Return what forbids the beam, the weightiest hold last: it is the one that is shown."""
        found = (
            self._rate.look(frame.received_ns),
            self._age.look(model, notices, frame.received_ns),
            self._shift.look(measurement.motion, has_zero=has_zero),
            self._repeats.look(frame),
            self._order.look(frame.device_index),
        )
        return tuple(one for one in found if one is not None)

    def forget_position(self) -> None:
        """Take the patient's next position for where they lie: a person has set the zero."""
        self._shift.forget()


class _FrameRate:
    """Counts the frames of the last second; says nothing before there was one."""

    def __init__(self, min_fps: float) -> None:
        self._min_fps = min_fps
        self._first_ns: int | None = None
        self._received_ns: deque[int] = deque()

    def look(self, received_ns: int) -> Interruption | None:
        if self._first_ns is None:
            self._first_ns = received_ns
        self._received_ns.append(received_ns)
        while received_ns - self._received_ns[0] >= NS_PER_S:
            self._received_ns.popleft()
        frames = len(self._received_ns)
        if received_ns - self._first_ns < NS_PER_S or frames >= self._min_fps:
            return None
        detail = f"{frames} frames within the last second, {self._min_fps:g} needed"
        return Interruption(HoldReason.FRAME_RATE_LOW, detail)


class _DeviceOrder:
    """Compares the camera's own numbers: pictures of the past may come with times that go on."""

    def __init__(self) -> None:
        self._last: int | None = None

    def look(self, device_index: int) -> Interruption | None:
        last, self._last = self._last, device_index
        if last is None or device_index > last:
            return None
        return Interruption(HoldReason.CLOCK_BACKWARDS, f"the camera's frame {device_index} after its frame {last}")
