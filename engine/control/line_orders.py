"""Orders of the engine thread to the beam line; each returns the line's answer as one value.

The line is ordered first; what it reads back, and the time, are read after that. Other threads use the line itself.
"""

from collections.abc import Callable

from engine.beam.line import BeamLine
from engine.control.turn_inputs import LineAnswer
from engine.control.watchdog import Watchdog
from engine.core.clock import Clock
from engine.core.gate_state import HoldReason, Lease
from engine.core.input_tap import NO_TAP, InputKind, InputTap


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
