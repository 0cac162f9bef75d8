"""The engine's time: monotonic nanoseconds from an injected clock, never the wall clock."""

import time
from typing import Protocol

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000
US_PER_S = 1_000_000

CLOCK_DRIFT = 1e-4
"""Greatest relative difference between a device's clock and the host's that is followed as drift: that of quartz."""


class Clock(Protocol):
    """A source of monotonic time."""

    def now_ns(self) -> int:
        """Return monotonic time [ns]; only differences are meaningful."""


class MonotonicClock:
    """The host's monotonic clock."""

    def now_ns(self) -> int:
        """Return ``time.monotonic_ns()``."""
        return time.monotonic_ns()


class ManualClock:
    """A clock that is advanced by its user: for replays and tests."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        """Return the time last set [ns]."""
        return self._now_ns

    def advance_ns(self, step_ns: int) -> None:
        """Advance by ``step_ns``; raise ValueError for a negative step."""
        if step_ns < 0:
            msg = f"a monotonic clock cannot go back by {-step_ns} ns"
            raise ValueError(msg)
        self._now_ns += step_ns
