"""A source in real time, for tests with real threads and processes; it can be asked to hang as a driver does."""

import threading

from engine.capture.source import SourceDescription
from engine.core.clock import NS_PER_S, Clock
from engine.core.frames import RgbdFrame
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from tests.support.control.loop_bench import DESCRIPTION, color_picture, depth_picture
from tests.support.gating.streams import PERIOD_NS

PATIENT_LIMITS = GateLimits(
    window=amplitude_window(lower_mm=-1.0, upper_mm=3.0),
    dwell_ms=100.0,
    lease_ms=200.0,
    max_frame_age_ms=200.0,
    max_gap_ms=200.0,
    max_lag_ms=500.0,
    operator_timeout_s=0.0,
    max_silence_ms=2_000.0,
    watchdog_ms=400.0,
)
"""For a busy test machine: what is proved does not depend on how short the times are."""


class PacedSource:
    """Frames at 29.97 a second by the clock."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._start_ns = clock.now_ns()
        self._index = 0
        self.hangs = threading.Event()
        self.released = threading.Event()
        self.is_hanging = threading.Event()

    def open(self) -> SourceDescription:
        return DESCRIPTION

    def read(self, timeout_s: float) -> RgbdFrame:
        assert timeout_s > 0.0
        if self.hangs.is_set():
            self.is_hanging.set()
            self.released.wait()
        due_ns = self._start_ns + self._index * PERIOD_NS
        threading.Event().wait(max(due_ns - self._clock.now_ns(), 0) / NS_PER_S)
        index = self._index
        self._index += 1
        return RgbdFrame(
            index=index,
            device_index=index,
            timestamp_us=1_000 + due_ns // 1_000,
            color_timestamp_us=1_000 + due_ns // 1_000,
            received_ns=self._clock.now_ns(),
            queue_empty_ns=due_ns,
            depth_mm=depth_picture(index),
            color=color_picture(index),
        )

    def close(self) -> None:
        """Nothing is held open."""
