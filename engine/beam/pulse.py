"""Short permits outside of any session, to measure how long a line takes: for commissioning, with the beam made safe.

Beside `engine.driver` the only caller of ``permit``; nothing but ``tidegate beam-line check --pulse`` uses it.
"""

from collections.abc import Callable
from dataclasses import dataclass

from engine.beam.line import BeamLine
from engine.clock import NS_PER_MS, NS_PER_S, Clock
from engine.errors import BeamLineError, InvalidValueError
from engine.permits import HoldReason, Lease

PULSE_BOUNDS_MS = (20.0, 200.0)
READY_NS = 3 * NS_PER_S
POLL_NS = NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True)
class PulseTimes:
    """How long two pulses took to be read back [ms]: on, off by a hold, off by the end of a lease."""

    on_ms: tuple[float, float]
    held_ms: float
    lapsed_ms: float


class Pulser:
    """Permits an open line for one short lease at a time; ``wait_ns`` waits."""

    def __init__(self, line: BeamLine, clock: Clock, *, pulse_ms: float, wait_ns: Callable[[int], None]) -> None:
        low, high = PULSE_BOUNDS_MS
        if not low <= pulse_ms <= high:
            raise InvalidValueError("pulse", pulse_ms, f"a number from {low:g} to {high:g} ms")
        self._line, self._clock, self._wait_ns = line, clock, wait_ns
        self._pulse_ns = int(pulse_ms * NS_PER_MS)
        self._sequence = 0

    def arm(self) -> None:
        """Arm the line as soon as it lets itself be armed; raise BeamLineError if that takes too long."""
        until_ns = self._clock.now_ns() + READY_NS
        while True:
            try:
                self._line.rearm()
            except BeamLineError:
                if self._clock.now_ns() >= until_ns:
                    raise
                self._wait_ns(POLL_NS)
            else:
                return

    def pulse(self) -> PulseTimes:
        """Permit twice, hold the first pulse when it was read back and let the second lapse.

        Raises
        ------
        BeamLineError
            The line failed, or never read back on within the pulse; it was held.
        """
        try:
            first_on_ms = self._permit()[0]
            told_ns = self._clock.now_ns()
            self._line.hold(HoldReason.OPERATOR_HOLD)
            held_ms = self._await(told_ns, is_on=False)
            self._wait_ns(POLL_NS)  # a permit decided in the same instant as a hold is refused
            second_on_ms, ends_ns = self._permit()
            self._wait_ns(max(ends_ns - self._clock.now_ns(), 0))
            lapsed_ms = self._await(ends_ns, is_on=False)
            return PulseTimes(on_ms=(first_on_ms, second_on_ms), held_ms=held_ms, lapsed_ms=lapsed_ms)
        finally:
            self._line.hold(HoldReason.OPERATOR_HOLD)

    def _permit(self) -> tuple[float, int]:
        """Permit; return how long it took to be read back, and when the lease ends."""
        self._sequence += 1
        now_ns = self._clock.now_ns()
        ends_ns = now_ns + self._pulse_ns
        self._line.permit(Lease(granted_ns=now_ns, expires_ns=ends_ns, sequence=self._sequence))
        return self._await(now_ns, is_on=True), ends_ns

    def _await(self, since_ns: int, *, is_on: bool) -> float:
        until_ns = since_ns + (self._pulse_ns if is_on else NS_PER_S)
        while self._line.is_on() is not is_on:
            if self._clock.now_ns() >= until_ns:
                msg = f"the line was never read back {'on' if is_on else 'off'}"
                raise BeamLineError(msg)
            self._wait_ns(POLL_NS)
        return (self._clock.now_ns() - since_ns) / NS_PER_MS
