"""The input tap that replays: readings come from a tape, and the outputs are compared with those on the tape."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

from engine.control.turn_inputs import Command, CommandInputs, FrameInput, LineAnswer, QueuedCommand, TurnInputs
from engine.core.errors import RecordingError
from engine.core.frames import RgbdFrame
from engine.core.input_tap import InputKind
from engine.gating.interlocks import DecisionInputs
from engine.offline.replay.comparison import BIT_FOR_BIT, DIGEST, NUMBERS, Comparison
from engine.offline.replay.encoding import FrameHead, Raised, TapeEncoding
from engine.offline.replay.outcomes import Row, is_transition, row_of, same, text_of
from engine.offline.replay.tape_file import OtherReadingError, RecordedReadings, RecordedTurn

T = TypeVar("T")

MISSING: Row = {}
VALUES: Mapping[InputKind, type] = {
    InputKind.TURN: TurnInputs,
    InputKind.COMMAND: CommandInputs,
    InputKind.FRAME: FrameInput,
    InputKind.DECISION: DecisionInputs,
    InputKind.LINE: LineAnswer,
}


class ReplayEnded(BaseException):
    """The tape is over, or the engine read something else than recorded: no error, and not caught in the engine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """The first difference; ``recorded`` and ``replayed`` are its two sides, in words.

    Attributes
    ----------
    is_of_numbers
        Whether only measured numbers differ, and every decision up to here is equal.
    """

    frame: int | None
    recorded: str
    replayed: str
    is_of_numbers: bool = False


class ReplayingTap:
    """Gives an engine its readings from a tape.

    Parameters
    ----------
    comparison
        What counts as the same.

    Attributes
    ----------
    frames, transitions
        Frames with the same outputs, and the gate's transitions, as replayed.
    recorded_transitions
        The same transitions as recorded.
    identical_frames
        Frames whose outputs are the same to the last bit.
    elsewhere
        Transitions that another thread made.
    difference
        The first difference; None where there is none.
    """

    def __init__(
        self,
        turns: Iterator[RecordedTurn],
        encoding: TapeEncoding,
        picture: Callable[[FrameHead], RgbdFrame],
        *,
        comparison: Comparison = BIT_FOR_BIT,
        on_turn: Callable[[], None] = lambda: None,
        on_output: Callable[[object], None] = lambda _outcome: None,
    ) -> None:
        self._turns, self._encoding, self._picture, self._on_turn = turns, encoding, picture, on_turn
        self._on_output = on_output
        self._comparison = comparison
        self._turn: RecordedTurn | None = next(turns, None)
        self._readings = self._readings_of(self._turn)
        self._emitted: list[Row] = []
        self._frame: int | None = None
        self.frames = self.identical_frames = 0
        self.transitions: list[Row] = []
        self.recorded_transitions: list[Row] = []
        self.elsewhere: list[Row] = []
        self.difference: Difference | None = None

    def begin(self) -> None:
        """Do nothing: a replay has one thread."""

    def observe(self, kind: InputKind, read: Callable[[], T]) -> T:
        """Return the next reading of the tape; end the replay where the tape has another kind next."""
        if self.difference is not None or self._turn is None:
            raise ReplayEnded
        try:
            answer = self._readings.take(kind)
        except OtherReadingError as other:
            self._compare_outputs(is_all=False)
            self._differ(f"{other.name or 'nothing more'} observed{self._decided()}", f"{kind.name} observed")
            raise ReplayEnded from None
        if isinstance(answer, Raised):
            raise answer.again()
        if not isinstance(answer, VALUES.get(kind, object)):
            msg = f"the tape is damaged: {kind.name} is a {type(answer).__name__}"
            raise RecordingError(msg)
        try:
            return cast("T", self._completed(kind, answer, read))
        except (AttributeError, TypeError) as error:
            msg = f"the tape is damaged: {type(error).__name__} in {kind.name}"
            raise RecordingError(msg) from error

    def emit(self, outcome: object) -> None:
        """Keep an output until the end of the turn."""
        self._emitted.append(row_of(outcome))
        self._on_output(outcome)

    def turn(self) -> None:
        """Compare this turn with the recorded one, and begin the next."""
        if self.difference is not None or self._turn is None:
            raise ReplayEnded
        self._compare_outputs()
        left = self._readings.rest()
        if left is not None:
            self._differ(f"{left} observed", "nothing more observed")
        if self.difference is not None:
            raise ReplayEnded
        self._turn = next(self._turns, None)
        self._readings = self._readings_of(self._turn)
        self._on_turn()

    def end(self) -> None:
        """End the last turn, unless the replay has ended already."""
        if self.difference is None and self._turn is not None:
            self.turn()

    def _readings_of(self, turn: RecordedTurn | None) -> RecordedReadings:
        return RecordedReadings((), self._encoding.decode) if turn is None else turn.readings(self._encoding.decode)

    def _completed(self, kind: InputKind, answer: Any, read: Callable[[], Any]) -> Any:  # noqa: ANN401
        """Complete a reading that is on the tape in part."""
        match kind:
            case InputKind.FRAME if answer.frame is not None:
                self._frame = answer.frame.index
                return replace(answer, frame=self._with_pictures(answer.frame))
            case InputKind.TURN:
                return replace(answer, commands=tuple(_queued(command) for command in answer.commands))
            case InputKind.LINE if answer.error is not None:
                return replace(answer, error=answer.error.again())
            case InputKind.TRAINED:
                return read() if answer else None
        return answer

    def _with_pictures(self, head: FrameHead) -> RgbdFrame:
        try:
            return self._picture(head)
        except RecordingError as error:
            self._differ(f"frame {head.index} at {head.timestamp_us} us", str(error))
            raise ReplayEnded from error

    def _compare_outputs(self, *, is_all: bool = True) -> None:
        """Compare the outputs with the recorded ones; within a turn only those that were made so far."""
        assert self._turn is not None
        rows, emitted = self._turn.rows, self._emitted
        self._emitted = []
        for place in range(max(len(rows), len(emitted)) if is_all else len(emitted)):
            then = rows[place] if place < len(rows) else MISSING
            now = emitted[place] if place < len(emitted) else MISSING
            if not self._comparison.agrees(then, now):
                self._differ_in(then, now)
                return
            if is_transition(now):
                self.transitions.append(now)
                self.recorded_transitions.append(then)
            else:
                self.frames += 1
                self.identical_frames += same(then, now)
        self.elsewhere += self._turn.elsewhere

    def _decided(self) -> str:
        """Name the recorded decision of this turn: an engine that reads something else decides differently."""
        rows = [] if self._turn is None else self._turn.rows
        decisions = [f"gate {row['gate']}, reason {row['reason']}" for row in rows if "gate" in row and "reason" in row]
        return f", decided: {decisions[-1]}" if decisions and not self._comparison.is_exact else ""

    def _differ_in(self, then: Row, now: Row) -> None:
        """Note the values in which two rows differ; both rows where one is missing."""
        if not then or not now or is_transition(then) != is_transition(now):
            self._differ(*(text_of(row) if row else "no output" for row in (then, now)))
            return
        names = self._comparison.differing(then, now)
        shown = [name for name in names if name != DIGEST] or names
        is_of_numbers = all(name == DIGEST or name in NUMBERS for name in names)
        if not is_of_numbers and not self._comparison.is_exact:
            # The numbers show how near to a bound the decision was.
            shown += [name for name in then if name in NUMBERS and name not in shown]
        sides = (", ".join(f"{name} {row.get(name)}" for name in shown) for row in (then, now))
        self._differ(*sides, is_of_numbers=is_of_numbers)

    def _differ(self, recorded: str, replayed: str, *, is_of_numbers: bool = False) -> None:
        if self.difference is None:
            self.difference = Difference(
                frame=self._frame, recorded=recorded, replayed=replayed, is_of_numbers=is_of_numbers
            )


def _queued(command: Command) -> QueuedCommand:
    return QueuedCommand(command=command, answer=Future(), submitted_ns=0)
