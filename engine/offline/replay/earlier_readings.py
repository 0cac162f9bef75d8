"""Reads tapes of format ``tidegate.tape/1``, which hold single readings, as the values of today's engine (ADR 0016).

The readings of a turn are grouped by their kinds, in the order in which that engine read them. An operator's hold that
was read once more for a record's name is skipped: the decision's value names the same operator.
"""

import enum
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from engine.control.turn_inputs import CommandInputs, FrameInput, LineAnswer, TurnInputs
from engine.core.errors import RecordingError
from engine.core.input_tap import InputKind
from engine.gating.interlocks import DecisionInputs
from engine.offline.replay.inputs import Raised
from engine.offline.replay.readings import OtherReadingError

AWAY, LATE = "SourceAwayError", "FrameTimeoutError"
DECISION_CLOCKS = 2
"""Readings of the clock in a decision that permits nothing: when it was made, and when the line had answered."""


class EarlierKind(enum.IntEnum):
    """The kind of a reading in ``tidegate.tape/1``."""

    CLOCK = 1
    STOP_REQUESTED = 2
    SOURCE_OPENED = 3
    FRAME = 4
    COMMANDS = 5
    COMMAND_IS_WANTED = 6
    REPORTED_FAULT = 7
    DISARM_REQUESTED = 8
    HOLD_REQUESTED = 9
    WATCHDOG_FIRED = 10
    WATCHDOG_RUNS = 11
    WATCHDOG_RECORDED = 12
    QUEUE_TROUBLE = 13
    WRITE_DELAY = 14
    OPERATOR_ABSENCE = 15
    LINE = 16
    TRAINED = 17


_K = EarlierKind


class EarlierReadings:
    """The readings of one turn; ``decode`` decodes one."""

    def __init__(self, observed: Sequence[tuple[enum.IntEnum, Any]], decode: Callable[[Any], Any]) -> None:
        self._observed, self._decode = observed, decode
        self._place = 0
        self._groups: Mapping[InputKind, Callable[[], Any]] = {
            InputKind.TURN: self._turn,
            InputKind.COMMAND: self._command,
            InputKind.FRAME: self._frame,
            InputKind.DECISION: self._decision,
            InputKind.LINE: self._line,
        }

    def take(self, kind: InputKind) -> Any:  # noqa: ANN401 - any reading
        """Return the next value, which is of this kind; raise OtherReadingError where another reading is next."""
        self._skip(_K.HOLD_REQUESTED)
        group = self._groups.get(kind)
        try:
            return self._take(EarlierKind[kind.name]) if group is None else group()
        except (AttributeError, TypeError) as error:
            msg = f"the tape is damaged: {type(error).__name__} in {kind.name}"
            raise RecordingError(msg) from error

    def rest(self) -> str | None:
        """Return the name of the next reading; None at the end. The time is read more often than it is used."""
        self._skip(_K.HOLD_REQUESTED, _K.CLOCK)
        kind = self._kind()
        return None if kind is None else kind.name

    def _kind(self, ahead: int = 0) -> enum.IntEnum | None:
        place = self._place + ahead
        return self._observed[place][0] if place < len(self._observed) else None

    def _take(self, kind: EarlierKind) -> Any:  # noqa: ANN401
        following = self._kind()
        if following is not kind:
            raise OtherReadingError(None if following is None else following.name)
        encoded = self._observed[self._place][1]
        self._place += 1
        return self._decode(encoded)

    def _take_if(self, kind: EarlierKind, otherwise: object) -> Any:  # noqa: ANN401
        """Return the next reading if it is of this kind: it was not read where it could have no effect."""
        return self._take(kind) if self._kind() is kind else otherwise

    def _skip(self, *kinds: EarlierKind) -> None:
        while self._kind() in kinds:
            self._place += 1

    def _turn(self) -> TurnInputs:
        if self._take(_K.STOP_REQUESTED):
            return TurnInputs(is_stop_requested=True)
        return TurnInputs(commands=tuple(self._take(_K.COMMANDS)))

    def _command(self) -> CommandInputs:
        return CommandInputs(
            is_wanted=self._take(_K.COMMAND_IS_WANTED),
            is_watchdog_running=self._take_if(_K.WATCHDOG_RUNS, otherwise=True),
            queue_trouble=self._take_if(_K.QUEUE_TROUBLE, otherwise=None),
        )

    def _frame(self) -> Any:  # noqa: ANN401 - a FrameInput, or an error that was raised
        self._skip(_K.CLOCK)
        frame = self._take(_K.FRAME)
        if not isinstance(frame, Raised):
            return FrameInput(frame=frame, at_ns=frame.received_ns)
        if frame.name not in {AWAY, LATE}:
            return frame
        # Whether a source never delivered a frame was read from the clock after the decision without one.
        at_ns = self._clock_ahead(DECISION_CLOCKS)
        return FrameInput(away=frame.text if frame.name == AWAY else None, at_ns=at_ns)

    def _decision(self) -> DecisionInputs:
        is_stop_requested = self._take_if(_K.STOP_REQUESTED, otherwise=False)
        while self._kind() is _K.CLOCK and self._kind(1) is _K.CLOCK:
            self._place += 1
        return DecisionInputs(
            is_stop_requested=is_stop_requested,
            at_ns=self._take(_K.CLOCK),
            watchdog_fired=self._take(_K.WATCHDOG_FIRED),
            is_watchdog_running=self._take_if(_K.WATCHDOG_RUNS, otherwise=True),
            reported_fault=self._take(_K.REPORTED_FAULT),
            queue_trouble=self._take(_K.QUEUE_TROUBLE),
            write_delay=self._take_if(_K.WRITE_DELAY, otherwise=None),
            operator_absence=self._take(_K.OPERATOR_ABSENCE),
            disarm_requested_by=self._take(_K.DISARM_REQUESTED),
            hold_requested_by=self._take_if(_K.HOLD_REQUESTED, otherwise=None),
        )

    def _line(self) -> LineAnswer:
        is_on, is_settling = True, False
        error = self._take(_K.LINE)
        if error is None and self._is_read_back():
            is_settling, is_on = self._take(_K.LINE), self._take(_K.LINE)
            if isinstance(is_on, Raised):
                error, is_on, is_settling = is_on, True, False
            else:
                is_settling = is_settling or self._take(_K.LINE)
        return LineAnswer(
            is_on=is_on,
            is_settling=is_settling,
            error=error,
            watchdog_fired=self._take_if(_K.WATCHDOG_FIRED, otherwise=False),
            at_ns=self._answered_ns(),
        )

    def _is_read_back(self) -> bool:
        """Whether the answer to the last order follows: an order itself has no value, or raised."""
        return self._kind() is _K.LINE and isinstance(self._decode(self._observed[self._place][1]), bool)

    def _answered_ns(self) -> int:
        """Return when the line had answered: the next reading of the clock, unless the next decision begins with it."""
        if self._kind() is _K.CLOCK and self._kind(1) is not _K.WATCHDOG_FIRED:
            at_ns: int = self._take(_K.CLOCK)
            return at_ns
        return self._clock_ahead()

    def _clock_ahead(self, skipped: int = 0) -> int:
        """Return a later reading of the clock, of which ``skipped`` precede it; the last one where there are less."""
        clocks: list[int] = [value for kind, value in self._observed[self._place :] if kind is _K.CLOCK]
        return clocks[min(skipped, len(clocks) - 1)] if clocks else 0
