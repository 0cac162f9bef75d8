"""A camera and a measuring in real time that can be made to misbehave while an engine runs on them."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from engine.capture.source import SourceDescription
from engine.core.breath import Breath
from engine.core.clock import NS_PER_MS, NS_PER_S, NS_PER_US, Clock
from engine.core.errors import FrameTimeoutError
from engine.core.frames import Measurement, RgbdFrame
from engine.gating.supervision.patient_shift import CORNERS, NODES
from tests.support.control.loop_bench import DESCRIPTION, RecordingPipeline, color_picture, depth_picture
from tests.support.gating.streams import PERIOD_NS, motion_of

MARKERS_MM = np.array([[-100.0, -150.0, 850.0], [100.0, -150.0, 850.0], [100.0, 150.0, 850.0], [-100.0, 150.0, 850.0]])


@dataclass(slots=True)
class Mischief:
    """What is wrong at present; the engine thread reads, the test writes.

    Attributes
    ----------
    edit
        Changes every frame as the camera delivers it.
    spoil
        Changes every measurement.
    is_silent, hang_ms, dawdle_ms
        No frame comes; the next read hangs for so long; the next measurement takes so long.
    error, bug
        What the camera, or the measuring, raises.
    """

    edit: Callable[[RgbdFrame], RgbdFrame] | None = None
    spoil: Callable[[Measurement], Measurement] | None = None
    period_ns: int = PERIOD_NS
    is_silent: bool = False
    hang_ms: float = 0.0
    dawdle_ms: float = 0.0
    is_frozen: bool = False
    error: Exception | None = None
    bug: Exception | None = None
    shift_mm: float = 0.0
    breaths: tuple[Breath, ...] = ()


def wait_ns(duration_ns: int) -> None:
    """Real time passes: this is a live run."""
    threading.Event().wait(max(duration_ns, 0) / NS_PER_S)


class LiveCamera:
    """Delivers a frame a period by the host's clock, taken when it is delivered."""

    def __init__(self, clock: Clock, mischief: Mischief) -> None:
        self._clock, self._mischief = clock, mischief
        self._index = 0
        self._due_ns = clock.now_ns()

    def open(self) -> SourceDescription:
        self._due_ns = self._clock.now_ns()
        return replace(DESCRIPTION, is_live=True)

    def read(self, timeout_s: float) -> RgbdFrame:
        mischief = self._mischief
        hang_ms, mischief.hang_ms = mischief.hang_ms, 0.0
        wait_ns(int(hang_ms * NS_PER_MS))
        if mischief.error is not None:
            raise mischief.error
        if mischief.is_silent:
            wait_ns(int(timeout_s * NS_PER_S))
            raise FrameTimeoutError("nothing came")
        now_ns = self._clock.now_ns()
        self._due_ns = max(self._due_ns + mischief.period_ns, now_ns)
        wait_ns(self._due_ns - now_ns)
        frame = self._frame()
        return frame if mischief.edit is None else mischief.edit(frame)

    def close(self) -> None:
        """Nothing is held open."""

    def _frame(self) -> RgbdFrame:
        index = self._index
        self._index += 1
        shown = 0 if self._mischief.is_frozen else index
        now_ns = self._clock.now_ns()
        return RgbdFrame(
            index=index,
            device_index=index,
            timestamp_us=now_ns // NS_PER_US,
            color_timestamp_us=now_ns // NS_PER_US,
            received_ns=now_ns,
            queue_empty_ns=now_ns,
            depth_mm=depth_picture(shown),
            color=color_picture(shown),
        )


class LivePipeline(RecordingPipeline):
    """Measures every frame as good, unless something is wrong; knows where the markers are."""

    def __init__(self, clock: Clock, mischief: Mischief) -> None:
        super().__init__(clock)
        self._mischief = mischief

    def measure(self, frame: RgbdFrame) -> Measurement:
        mischief = self._mischief
        dawdle_ms, mischief.dawdle_ms = mischief.dawdle_ms, 0.0
        wait_ns(int(dawdle_ms * NS_PER_MS))
        if mischief.bug is not None:
            raise mischief.bug
        surface_mm = np.zeros((NODES, 3))
        surface_mm[list(CORNERS)] = MARKERS_MM + np.array([mischief.shift_mm, 0.0, 0.0])
        measured = super().measure(frame)
        if measured.motion is None:
            return measured
        good = replace(measured, motion=replace(motion_of(), surface_mm=surface_mm), breaths=mischief.breaths)
        return good if mischief.spoil is None else mischief.spoil(good)
