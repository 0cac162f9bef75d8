"""Short permits outside of sessions, to measure a line's times: for commissioning, with the accelerator made safe.

The only caller of ``permit`` besides `engine.control.beam_driver`. Users are ``tidegate beam-line check --pulse``,
the drill of the heartbeat (`engine.beam.heartbeat_drill`) and the drills of QA (`engine.qa.drill`).
"""

from collections.abc import Callable
from dataclasses import dataclass

from engine.beam.line import BeamLine
from engine.core.bounds import check_number
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease

PULSE_BOUNDS_MS = (20.0, 200.0)
READY_NS = 3 * NS_PER_S
POLL_NS = NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True)
class PulseTimes:
    """Times from command to read-back of two pulses [ms]: on, off by a hold, off by the end of the lease."""

    on_ms: tuple[float, float]
    held_ms: float
    lapsed_ms: float


class Pulser:
    """Permits an open line for one short lease at a time; ``wait_ns`` sleeps for so many nanoseconds."""

    def __init__(self, line: BeamLine, clock: Clock, *, pulse_ms: float, wait_ns: Callable[[int], None]) -> None:
        check_number("pulse", pulse_ms, *PULSE_BOUNDS_MS, "ms")
        self._line, self._clock, self._wait_ns = line, clock, wait_ns
        self._pulse_ns = int(pulse_ms * NS_PER_MS)
        self._sequence = 0

    def arm(self) -> None:
        """Arm the line as soon as it accepts; raise BeamLineError where it does not within 3 s."""
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
        """Permit twice: hold the first pulse once it was read back, and let the second lapse.

        Raises
        ------
        BeamLineError
            The line failed, or never read back on within the pulse; it was held.
        """
        try:
            first_on_ms = self.permit()[0]
            held_ns = self._clock.now_ns()
            self._line.hold(HoldReason.OPERATOR_HOLD)
            held_ms = self.await_off(held_ns)
            self._wait_ns(POLL_NS)  # a permit decided in the same instant as a hold is refused
            second_on_ms, ends_ns = self.permit()
            self._wait_ns(max(ends_ns - self._clock.now_ns(), 0))
            lapsed_ms = self.await_off(ends_ns)
            return PulseTimes(on_ms=(first_on_ms, second_on_ms), held_ms=held_ms, lapsed_ms=lapsed_ms)
        finally:
            self._line.hold(HoldReason.OPERATOR_HOLD)

    def permit(self) -> tuple[float, int]:
        """Permit; return the time to its read-back [ms] and the end of the lease [ns]. The caller holds."""
        lease = self._next_lease()
        self._line.permit(lease)
        return self._await(lease.granted_ns, is_on=True), lease.expires_ns

    def renew(self) -> None:
        """Permit for one more lease without waiting for the read-back; raise BeamLineError if that is refused."""
        self._line.permit(self._next_lease())

    def hold(self) -> None:
        """Withdraw the permit."""
        self._line.hold(HoldReason.OPERATOR_HOLD)

    def is_refused(self) -> bool:
        """Whether the line refuses a permit, as a latched line must. The caller holds."""
        try:
            self._line.permit(self._next_lease())
        except BeamLineError:
            return True
        return False

    def await_off(self, since_ns: int) -> float:
        """Wait until the line reads back off; return the time since ``since_ns`` [ms]."""
        return self._await(since_ns, is_on=False)

    def _next_lease(self) -> Lease:
        self._sequence += 1
        now_ns = self._clock.now_ns()
        return Lease(granted_ns=now_ns, expires_ns=now_ns + self._pulse_ns, sequence=self._sequence)

    def _await(self, since_ns: int, *, is_on: bool) -> float:
        until_ns = since_ns + (self._pulse_ns if is_on else NS_PER_S)
        while self._line.is_on() is not is_on:
            if self._clock.now_ns() >= until_ns:
                msg = f"the line was never read back {'on' if is_on else 'off'}"
                raise BeamLineError(msg)
            self._wait_ns(POLL_NS)
        return (self._clock.now_ns() - since_ns) / NS_PER_MS
