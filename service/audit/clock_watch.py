"""The wall clock against the monotonic one: whoever sets it makes the audit's times mean something else.

The monotonic clock is slewed together with the wall clock, so that a time server that pulls it right slowly is not
seen; a clock that was set, by hand or by a time server that gave up slewing, and a machine that slept, are.
"""

from collections.abc import Callable
from datetime import datetime, timedelta

from engine.clock import NS_PER_MS, Clock
from service.audit.chain import Event
from service.audit.start import clock_event

NS_PER_US = 1000


class ClockWatch:
    """Keeps one moment on both clocks, and compares every later one with it."""

    def __init__(
        self, *, clock: Clock, now: Callable[[], datetime], jump_ms: float, write: Callable[[Event], None]
    ) -> None:
        self._clock = clock
        self._now = now
        self._jump_ns = round(jump_ms * NS_PER_MS)
        self._write = write
        self._at, self._at_ns = now(), clock.now_ns()

    def look(self) -> None:
        """Compare; a jump is written down once, and then the new time is what holds."""
        at, at_ns = self._now(), self._clock.now_ns()
        expected = self._at + timedelta(microseconds=(at_ns - self._at_ns) / NS_PER_US)
        if abs((at - expected) / timedelta(microseconds=1)) * NS_PER_US <= self._jump_ns:
            return
        # Written first: what could not be written down is seen again at the next look.
        self._write(clock_event(before=expected, after=at, seen="while the service ran"))
        self._at, self._at_ns = at, at_ns
