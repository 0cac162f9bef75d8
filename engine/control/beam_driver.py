"""Drives the beam line as the gate decided, and trusts only what the line reads back.

Orders of the engine thread to the beam line; each returns the line's answer as one value.

The line is ordered first; what it reads back, and the time, are read after that. Other threads use the line itself.
"""

from collections.abc import Callable
from dataclasses import dataclass

from engine.beam.line import BeamLine
from engine.control.turn_inputs import LineAnswer
from engine.control.watchdog import Watchdog
from engine.core.clock import Clock
from engine.core.errors import BeamLineMismatchError, LeaseLapsedError
from engine.core.gate_state import GateState, HoldReason, Lease
from engine.core.input_tap import NO_TAP, InputKind, InputTap
from engine.core.replacing import replace
from engine.core.sentences import say
from engine.gating.gate import Gate, Interruption, lease_of
from engine.gating.limits import GateLimits

LAPSED = Interruption(HoldReason.FRAME_LATE, say("the lease before had lapsed in the line"))


class LineOrders:
    """Orders one line.

    Parameters
    ----------
    clock
        The host's clock; the tap records its readings as part of the answers.
    """

    def __init__(self, line: BeamLine, *, clock: Clock, watchdog: Watchdog, tap: InputTap = NO_TAP) -> None:
        self._line, self._clock, self._watchdog, self._tap = line, clock, watchdog, tap

    def connect(self) -> None:
        """Connect, and hold; raise what the line raises."""
        _raise_error(self._order(self._line.open, reads_back=False))
        _raise_error(self.hold_again(HoldReason.DISARMED))

    def rearm(self) -> None:
        """Let the line accept permits again; raise what the line raises."""
        _raise_error(self._order(self._line.rearm, reads_back=False))

    def permit(self, lease: Lease) -> LineAnswer:
        """Let the beam be on until the lease ends."""
        return self._order(lambda: self._line.permit(lease))

    def hold(self, reason: HoldReason) -> LineAnswer:
        """Withdraw the permit now."""
        return self._order(lambda: self._line.hold(reason))

    def hold_again(self, reason: HoldReason) -> LineAnswer:
        """Withdraw the permit without a read-back: of a line that could not be held, it would prove nothing."""
        return self._order(lambda: self._line.hold(reason), reads_back=False)

    def _order(self, order: Callable[[], None], *, reads_back: bool = True) -> LineAnswer:
        return self._tap.observe(InputKind.LINE, lambda: self._answer(order, reads_back=reads_back))

    def _answer(self, order: Callable[[], None], *, reads_back: bool) -> LineAnswer:
        is_on, is_settling, error = True, False, None
        try:
            order()
            if reads_back:
                is_on, is_settling = self._read_back()
        except Exception as raised:  # noqa: BLE001 - any error of a line is a failure of the line
            error = raised
        return LineAnswer(
            is_on=is_on,
            is_settling=is_settling,
            error=error,
            watchdog_fired=self._watchdog.has_fired,
            at_ns=self._clock.now_ns(),
        )

    def _read_back(self) -> tuple[bool, bool]:
        """Read whether the line is on and whether it settles, the latter twice: its own thread runs on meanwhile."""
        is_settling = self._line.is_settling
        is_on = self._line.is_on()
        return is_on, is_settling or self._line.is_settling


def _raise_error(answer: LineAnswer) -> None:
    if answer.error is not None:
        raise answer.error


@dataclass(frozen=True, slots=True, kw_only=True)
class LineReport:
    """The line's state after an order.

    ``is_on`` is as read back, and True where the line did not answer, since it may be on. ``trouble`` is a fault for
    the gate; the line was held for it already. ``is_settling`` means that the order may not have taken effect yet: a
    permitted line is still off, or a held one still on, and neither is a fault until the line reports one.
    ``asserted_ns`` is the time of the line's last answer, and ``watchdog_fired`` whether the watchdog had held the line
    by then.
    """

    is_on: bool
    asserted_ns: int
    watchdog_fired: bool = False
    trouble: Interruption | None = None
    is_settling: bool = False


class BeamDriver:
    """The only caller of ``permit``; owned by the engine thread."""

    def __init__(self, *, line: LineOrders, clock: Clock, limits: GateLimits) -> None:
        self._line = line
        self._clock = clock
        self._limits = limits
        self._sequence = 0
        self._permitted: Lease | None = None

    def carry_out(self, gate: Gate, decided_ns: int) -> LineReport:
        """Permit in ``BEAM_ON``, hold in every other state, and read the line back."""
        if gate.state is GateState.BEAM_ON:
            return self._permit(gate, decided_ns)
        return self._hold(gate.reason or HoldReason.UNKNOWN)

    def _permit(self, gate: Gate, decided_ns: int) -> LineReport:
        self._sequence += 1
        lease = lease_of(gate, decided_ns=decided_ns, sequence=self._sequence, limits=self._limits)
        now_ns = self._clock.now_ns()
        if lease is None or not lease.is_live(now_ns):
            return self._hold_for(Interruption(HoldReason.FRAME_LATE, say("the decision took longer than its lease")))
        if self._permitted is not None and not self._permitted.is_live(now_ns):
            # Decided in time, ordered too late: the line has gone off by itself, and may be on again after a dwell.
            return self._hold_for(LAPSED)
        self._permitted = lease
        answer = self._line.permit(lease)
        if answer.error is None and (answer.is_on or answer.is_settling):
            return _report(answer, is_settling=not answer.is_on)
        if isinstance(answer.error, LeaseLapsedError):  # it lapsed while the order was on its way
            return self._hold_for(LAPSED)
        if not lease.is_live(answer.at_ns):
            return self._hold_for(
                Interruption(HoldReason.FRAME_LATE, say("the lease lapsed before the line had answered"))
            )
        return self._hold_for(_trouble_of(answer, say("the line is off, though permitted")))

    def _hold_for(self, trouble: Interruption) -> LineReport:
        report = self._hold(trouble.reason)
        return replace(report, trouble=report.trouble or trouble)

    def _hold(self, reason: HoldReason) -> LineReport:
        self._permitted = None
        answer = self._line.hold(reason)
        if answer.error is None and (not answer.is_on or answer.is_settling):
            return _report(answer, is_settling=answer.is_on)
        trouble = _trouble_of(answer, "the line is on, though held")
        return _report(self._line.hold_again(trouble.reason), trouble=trouble)


def _report(answer: LineAnswer, *, is_settling: bool = False, trouble: Interruption | None = None) -> LineReport:
    return LineReport(
        is_on=answer.is_on,
        asserted_ns=answer.at_ns,
        watchdog_fired=answer.watchdog_fired,
        trouble=trouble,
        is_settling=is_settling,
    )


def _trouble_of(answer: LineAnswer, mismatch: str) -> Interruption:
    error = answer.error or BeamLineMismatchError(mismatch)
    is_mismatch = isinstance(error, BeamLineMismatchError)
    reason = HoldReason.BEAM_LINE_MISMATCH if is_mismatch else HoldReason.BEAM_LINE_FAILED
    return Interruption(reason, str(error) or type(error).__name__)
