"""Detects steps of the system clock by comparison with the monotonic clock, since audit times depend on it.

Both clocks are slewed together, so a slow correction by a time server is not detected; a step by hand or by a time
server, and a suspended machine, are.
"""

from collections.abc import Callable
from datetime import datetime, timedelta

from engine.core.clock import NS_PER_MS, Clock
from service.storage.audit.chain import Event
from service.storage.audit.startup import clock_event

NS_PER_US = 1000


class ClockWatch:
    """Compares both clocks with their values at the start or at the last step; ``jump_ms`` is the tolerance [ms]."""

    def __init__(
        self, *, clock: Clock, now: Callable[[], datetime], jump_ms: float, write: Callable[[Event], None]
    ) -> None:
        self._clock = clock
        self._now = now
        self._jump_ns = round(jump_ms * NS_PER_MS)
        self._write = write
        self._at, self._at_ns = now(), clock.now_ns()

    def check(self) -> None:
        """Compare the clocks; audit a step once and take the new time as reference."""
        at, at_ns = self._now(), self._clock.now_ns()
        expected = self._at + timedelta(microseconds=(at_ns - self._at_ns) / NS_PER_US)
        if abs((at - expected) / timedelta(microseconds=1)) * NS_PER_US <= self._jump_ns:
            return
        # Written first: if the write fails, the next check detects the step again.
        self._write(clock_event(before=expected, after=at, seen="while the service ran"))
        self._at, self._at_ns = at, at_ns
