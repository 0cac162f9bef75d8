"""Supervises a wired line by its commands and read-backs: every answer in time, every command followed.

No thread, no clock and no wire: callers pass the time. The guarantee is :data:`DETECTION_MS`, from the moment a line
stops answering or stops following commands to the fault. It is the sum of the exchange period, the time of an answer,
the time the contact takes to settle, and the watch period; so the two times that a site chooses are bounded together.
"""

from collections import deque
from dataclasses import dataclass

from engine.core.bounds import check_numbers
from engine.core.clock import NS_PER_MS
from engine.core.errors import InvalidValueError
from engine.core.gate_state import HoldReason
from engine.core.sentences import say

CYCLE_MS = 20.0
"""Period of the exchanges with the line."""

WATCH_MS = 10.0
"""Period of the check for an overdue line, by another thread than the one that waits for the answer."""

DETECTION_MS = 200.0
"""Longest time to the detection of any fault."""

SLACK_MS = 10.0
"""Allowance in it for threads that are scheduled late."""

TIME_BOUNDS: dict[str, tuple[float, float]] = {"answer_ms": (20.0, 150.0), "settle_ms": (0.0, 150.0)}
MAX_ANSWER_AND_SETTLE_MS = DETECTION_MS - CYCLE_MS - WATCH_MS - SLACK_MS
GOOD_ANSWERS = 3
"""Consecutive good answers before a line that had a fault may be armed again."""

HISTORY = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class LineTimes:
    """Time limits of a site's line.

    Attributes
    ----------
    answer_ms
        Longest time from a request to its complete answer.
    settle_ms
        Longest time from a command to the contact having followed.
    """

    answer_ms: float = 100.0
    settle_ms: float = 60.0

    def __post_init__(self) -> None:
        """Refuse what is out of its bound, alone or together."""
        check_numbers(self, TIME_BOUNDS)
        if self.answer_ms + self.settle_ms > MAX_ANSWER_AND_SETTLE_MS:
            bound = f"at most {MAX_ANSWER_AND_SETTLE_MS - self.answer_ms:g} with answer_ms {self.answer_ms:g}"
            raise InvalidValueError("settle_ms", self.settle_ms, bound)

    @property
    def answer_ns(self) -> int:
        """Longest time to an answer [ns]."""
        return int(self.answer_ms * NS_PER_MS)

    @property
    def settle_ns(self) -> int:
        """Longest time of the contact to follow [ns]."""
        return int(self.settle_ms * NS_PER_MS)

    @property
    def follow_ns(self) -> int:
        """Longest time from a command to its read-back [ns]."""
        return self.answer_ns + self.settle_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Trouble:
    """A fault of a line; ``reason`` latches."""

    reason: HoldReason
    detail: str
    at_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadEdge:
    """A command that was read back; it was due from ``commanded_ns``, and confirmed at ``read_ns``."""

    is_on: bool
    commanded_ns: int
    read_ns: int


class LineSupervisor:
    """The newest command and read-back, and since when they hold.

    Its user serialises the calls that change it; any thread may read the attributes.

    Attributes
    ----------
    commands_on
        Command of the newest exchange.
    reads_on
        Read-back of the newest answer.
    may_be_on
        On was commanded, or no answer is known yet, and no later answer has proved the line off.
    edges
        Commands that were read back, as far as a bounded history reaches.
    answers_ns
        Times of the answers, as far as it reaches [ns].
    """

    def __init__(self, times: LineTimes, *, now_ns: int) -> None:
        self._times = times
        self.commands_on = False
        self.reads_on = False
        self.may_be_on = True
        self.edges: deque[ReadEdge] = deque(maxlen=HISTORY)
        self.answers_ns: deque[int] = deque(maxlen=HISTORY)
        self._asked_ns: int | None = None
        self._answered_ns = now_ns
        self._on_since_ns = now_ns - times.follow_ns
        self._off_since_ns: int | None = now_ns
        self._was_read_on = True
        self._good_answers = 0

    def begin(self, *, commands_on: bool, now_ns: int) -> None:
        """Note the start of an exchange and its command."""
        if commands_on and not self.commands_on:
            self._on_since_ns = now_ns
            self._was_read_on = False
            self.may_be_on = True
        self.commands_on = commands_on
        self._asked_ns = now_ns
        self._note_off(now_ns)

    def answered(self, *, reads_on: bool, now_ns: int) -> Trouble | None:
        """Note an answer; return the fault that it shows, if any."""
        took_ns = now_ns - (now_ns if self._asked_ns is None else self._asked_ns)
        self._asked_ns = None
        self.answers_ns.append(took_ns)
        self._answered_ns = now_ns
        self.reads_on = reads_on
        self._follow(reads_on=reads_on, now_ns=now_ns)
        trouble = self._deviation(now_ns)
        if took_ns > self._times.answer_ns:
            trouble = trouble or self._silence(took_ns, now_ns)
        self._good_answers = self._good_answers + 1 if trouble is None and not self.may_be_on else 0
        return trouble

    def failed(self, *, now_ns: int) -> None:
        """Note a failed exchange; its command may have reached the line nevertheless."""
        self.commands_on = False
        self._note_off(now_ns)
        self._asked_ns = None
        self._good_answers = 0

    def check(self, *, wants_on: bool, now_ns: int) -> Trouble | None:
        """Return a fault where the line is overdue; ``wants_on`` is the command due by now."""
        if not wants_on:
            self._note_off(now_ns, is_commanded=False)
        if self._asked_ns is not None and now_ns - self._asked_ns > self._times.answer_ns:
            return self._silence(now_ns - self._asked_ns, now_ns)
        return self._deviation(now_ns)

    def may_command_on(self, *, held_at_ns: int | None) -> bool:
        """Whether on may be commanded: only after the newest off was commanded and read back.

        Otherwise a stuck line would stay undetected, and a hold during a long exchange would be skipped.
        """
        if not self.commands_on:
            return not self.may_be_on
        return self._off_since_ns is None and (held_at_ns is None or held_at_ns < self._on_since_ns)

    def is_healthy(self, now_ns: int) -> bool:
        """Whether the last answers were good and the line is off."""
        return self._good_answers >= GOOD_ANSWERS and not self.is_silent(now_ns)

    def is_silent(self, now_ns: int) -> bool:
        """Whether the newest answer is older than `DETECTION_MS`: the exchanges, or the checks, have stopped."""
        return now_ns - self._answered_ns > int(DETECTION_MS * NS_PER_MS)

    def _note_off(self, now_ns: int, *, is_commanded: bool = True) -> None:
        if self.may_be_on and self._off_since_ns is None and not (is_commanded and self.commands_on):
            self._off_since_ns = now_ns

    def _follow(self, *, reads_on: bool, now_ns: int) -> None:
        """Note the command that an answer proves, if any."""
        if self.commands_on and reads_on and not self._was_read_on:
            self._was_read_on = True
            self.edges.append(ReadEdge(is_on=True, commanded_ns=self._on_since_ns, read_ns=now_ns))
        # A contact commanded on a moment ago and never read on may still be closing.
        has_arrived = self._was_read_on or now_ns - self._on_since_ns >= self._times.settle_ns
        if not self.commands_on and not reads_on and self.may_be_on and has_arrived:
            commanded_ns = now_ns if self._off_since_ns is None else self._off_since_ns
            self.edges.append(ReadEdge(is_on=False, commanded_ns=commanded_ns, read_ns=now_ns))
            self.may_be_on = False
            self._off_since_ns = None

    def _deviation(self, now_ns: int) -> Trouble | None:
        """Return a fault where the read-back has differed from the command for longer than the line may take."""
        if self._off_since_ns is not None:
            return self._not_followed(self._off_since_ns, now_ns, "on", "off")
        if self.commands_on and not self.reads_on:
            return self._not_followed(self._on_since_ns, now_ns, "off", "on")
        if not self.commands_on and self.reads_on:
            return self._not_followed(now_ns - self._times.follow_ns - 1, now_ns, "on", "off")
        return None

    def _not_followed(self, since_ns: int, now_ns: int, reads: str, command: str) -> Trouble | None:
        if now_ns - since_ns <= self._times.follow_ns:
            return None
        self._good_answers = 0
        if command == "off" and (not self.reads_on or self._answered_ns < since_ns):
            detail = say(
                "the beam line has not confirmed off within {within_ms:.0f} ms of the hold",
                within_ms=self._times.follow_ns / NS_PER_MS,
            )
            return Trouble(reason=HoldReason.BEAM_LINE_FAILED, detail=detail, at_ns=now_ns)
        detail = say("the beam line reads back {reads} after the command {command}", reads=reads, command=command)
        return Trouble(reason=HoldReason.BEAM_LINE_MISMATCH, detail=detail, at_ns=now_ns)

    def _silence(self, waited_ns: int, now_ns: int) -> Trouble:
        self._good_answers = 0
        detail = say("the beam line has not answered for {waited_ms:.0f} ms", waited_ms=waited_ns / NS_PER_MS)
        return Trouble(reason=HoldReason.BEAM_LINE_FAILED, detail=detail, at_ns=now_ns)
