"""The witness that answers from a tape: nobody is asked, and what comes of it is held against what came of it then."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from engine.commands import Command
from engine.errors import RecordingError
from engine.frames import RgbdFrame
from engine.mailbox import Letter
from engine.replaying.heard import FrameHead, Raised
from engine.replaying.outcomes import Row, is_transition, row_of, same, text_of
from engine.replaying.spelling import Spelling
from engine.replaying.tape_file import HeardTurn
from engine.witness import Seam

T = TypeVar("T")

NOT_TOLD: Row = {}


class RehearsalOver(BaseException):
    """The tape is over, or the engine went another way than then: no error, and nothing in the engine catches it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """The first thing that is not as it was; ``recorded`` and ``replayed`` are the two sides, in words."""

    frame: int | None
    recorded: str
    replayed: str


class Rehearing:
    """Answers an engine from a tape.

    Attributes
    ----------
    frames, transitions
        Frames that came out the same, and the changes of the gate, told by another thread included.
    difference
        What was not the same; None as long as all is.
    """

    def __init__(
        self,
        turns: Iterator[HeardTurn],
        spelling: Spelling,
        picture: Callable[[FrameHead], RgbdFrame],
        *,
        on_turn: Callable[[], None] = lambda: None,
        on_told: Callable[[object], None] = lambda _outcome: None,
    ) -> None:
        self._turns, self._spelling, self._picture, self._on_turn = turns, spelling, picture, on_turn
        self._on_told = on_told
        self._turn: HeardTurn | None = next(turns, None)
        self._answers = self._answers_of(self._turn)
        self._told: list[Row] = []
        self._frame: int | None = None
        self.frames = 0
        self.transitions: list[Row] = []
        self.elsewhere: list[Row] = []
        self.difference: Difference | None = None

    def begin(self) -> None:
        """Care for no thread: there is only one."""

    def heard(self, seam: Seam, ask: Callable[[], T]) -> T:
        """Answer as was answered then."""
        if self.difference is not None or self._turn is None:
            raise RehearsalOver
        then, words = next(self._answers, (None, None))
        if then is not seam:
            self._compare_told(is_all=False)
            self._differ(f"{'nothing more' if then is None else then.name} heard", f"{seam.name} asked")
            raise RehearsalOver
        answer = self._spelling.read(words)
        if isinstance(answer, Raised):
            raise answer.again()
        return cast("T", self._whole(seam, answer, ask))

    def told(self, outcome: object) -> None:
        """Keep what came of it until the turn is over."""
        self._told.append(row_of(outcome))
        self._on_told(outcome)

    def turn(self) -> None:
        """Hold this turn against the one of then, and begin the next."""
        if self.difference is not None or self._turn is None:
            raise RehearsalOver
        self._compare_told()
        left = next(self._answers, None)
        if left is not None:
            self._differ(f"{left[0].name} heard", "asked for nothing more")
        if self.difference is not None:
            raise RehearsalOver
        self._turn = next(self._turns, None)
        self._answers = self._answers_of(self._turn)
        self._on_turn()

    def end(self) -> None:
        """Take the last turn, unless all is over already."""
        if self.difference is None and self._turn is not None:
            self.turn()

    @staticmethod
    def _answers_of(turn: HeardTurn | None) -> Iterator[tuple[Seam, Any]]:
        return iter(() if turn is None else turn.heard)

    def _whole(self, seam: Seam, answer: Any, ask: Callable[[], Any]) -> Any:  # noqa: ANN401
        """Make an answer whole that is on the tape in part."""
        match seam:
            case Seam.FRAME:
                self._frame = answer.index
                return self._pictured(answer)
            case Seam.LETTERS:
                return [_letter(command) for command in answer]
            case Seam.TRAINED:
                return ask() if answer else None
        return answer

    def _pictured(self, head: FrameHead) -> RgbdFrame:
        try:
            return self._picture(head)
        except RecordingError as error:
            self._differ(f"frame {head.index} at {head.timestamp_us} us", str(error))
            raise RehearsalOver from error

    def _compare_told(self, *, is_all: bool = True) -> None:
        """Hold what was told against what was told then; not all of it within a turn."""
        assert self._turn is not None
        rows, told = self._turn.rows, self._told
        self._told = []
        for place in range(max(len(rows), len(told)) if is_all else len(told)):
            then = rows[place] if place < len(rows) else NOT_TOLD
            now = told[place] if place < len(told) else NOT_TOLD
            if not same(then, now):
                self._differ(*_what_differs(then, now))
                return
            if is_transition(now):
                self.transitions.append(now)
            else:
                self.frames += 1
        self.elsewhere += self._turn.elsewhere

    def _differ(self, recorded: str, replayed: str) -> None:
        if self.difference is None:
            self.difference = Difference(frame=self._frame, recorded=recorded, replayed=replayed)


def _letter(command: Command) -> Letter:
    return Letter(command=command, answer=Future(), submitted_ns=0)


def _what_differs(then: Row, now: Row) -> tuple[str, str]:
    """Return the parts of two rows that differ, in words; all of both where one is missing."""
    if not then or not now or is_transition(then) != is_transition(now):
        return (text_of(then) if then else "nothing told"), (text_of(now) if now else "nothing told")
    names = [name for name in then if not same({"": then[name]}, {"": now.get(name)})]
    shown = [name for name in names if name != "digest"] or names
    return (
        ", ".join(f"{name} {then[name]}" for name in shown),
        ", ".join(f"{name} {now.get(name)}" for name in shown),
    )
