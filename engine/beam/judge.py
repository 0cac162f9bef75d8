"""Judges a wired line by what it was told and what it read back: in time, alike, or in trouble.

No thread, no clock and no wire: times are handed in, so that a test can hand in any. What is promised is
:data:`DETECTION_MS`: from the moment a line stops answering, or stops doing as told, to the verdict. It is the sum of
how long nothing may be asked, how long an answer may take, how long the line may take to follow, and how often somebody
looks; which is why the two that a site chooses are bounded together.
"""

from collections import deque
from dataclasses import dataclass

from engine.clock import NS_PER_MS
from engine.errors import InvalidValueError
from engine.permits import HoldReason

CYCLE_MS = 20.0
"""The line is told and asked so often."""

WATCH_MS = 10.0
"""Whether the line is overdue is looked at so often, by another thread than the one that waits for it."""

DETECTION_MS = 200.0
"""No trouble stays unknown for longer."""

SLACK_MS = 10.0
"""What is left of it for threads that are woken late."""

TIME_BOUNDS: dict[str, tuple[float, float]] = {"answer_ms": (20.0, 150.0), "settle_ms": (0.0, 150.0)}
MAX_ANSWER_AND_SETTLE_MS = DETECTION_MS - CYCLE_MS - WATCH_MS - SLACK_MS
GOOD_ANSWERS = 3
"""So many good answers in a row before a line that was in trouble may be armed again."""

HISTORY = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class LineTimes:
    """How long a site's line may take.

    Attributes
    ----------
    answer_ms
        Longest time from asking the line to its whole answer.
    settle_ms
        Longest time from telling the line to its contact having followed.
    """

    answer_ms: float = 100.0
    settle_ms: float = 60.0

    def __post_init__(self) -> None:
        """Refuse what is out of its bound, alone or together."""
        for name, (low, high) in TIME_BOUNDS.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                raise InvalidValueError(name, value, f"a number from {low:g} to {high:g}")
        if self.answer_ms + self.settle_ms > MAX_ANSWER_AND_SETTLE_MS:
            bound = f"at most {MAX_ANSWER_AND_SETTLE_MS - self.answer_ms:g} with answer_ms {self.answer_ms:g}"
            raise InvalidValueError("settle_ms", self.settle_ms, bound)

    @property
    def answer_ns(self) -> int:
        """Longest time to an answer [ns]."""
        return int(self.answer_ms * NS_PER_MS)

    @property
    def settle_ns(self) -> int:
        """Longest time to follow [ns]."""
        return int(self.settle_ms * NS_PER_MS)

    @property
    def follow_ns(self) -> int:
        """Longest time from an order to having read back that it was followed [ns]."""
        return self.answer_ns + self.settle_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Trouble:
    """What is wrong with a line; ``reason`` latches."""

    reason: HoldReason
    detail: str
    at_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadEdge:
    """An order that was read back: ``told_ns`` is when it was first known, ``read_ns`` when the line agreed."""

    is_on: bool
    told_ns: int
    read_ns: int


class LineJudge:
    """What was told, what was read, and since when.

    Calls that change it are made one at a time (the line locks); the properties may be read by any thread.

    Attributes
    ----------
    tells_on
        What the newest exchange tells.
    reads_on
        What the newest answer said.
    may_be_on
        On was told, or nothing is known yet, and no later answer has proved the line off.
    edges
        Orders that were read back, as far as a bounded history reaches.
    answers_ns
        How long the answers took, as far as it reaches [ns].
    """

    def __init__(self, times: LineTimes, *, now_ns: int) -> None:
        self._times = times
        self.tells_on = False
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

    def begin(self, *, tells_on: bool, now_ns: int) -> None:
        """Note that the line is being told, and asked."""
        if tells_on and not self.tells_on:
            self._on_since_ns = now_ns
            self._was_read_on = False
            self.may_be_on = True
        self.tells_on = tells_on
        self._asked_ns = now_ns
        self._note_off(now_ns)

    def answered(self, *, reads_on: bool, now_ns: int) -> Trouble | None:
        """Note an answer; return what is wrong with it."""
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
        """Note that the exchange came to nothing; what was told may have arrived all the same."""
        self.tells_on = False
        self._note_off(now_ns)
        self._asked_ns = None
        self._good_answers = 0

    def check(self, *, wants_on: bool, now_ns: int) -> Trouble | None:
        """Look whether the line is overdue; ``wants_on`` is what it should be told by now."""
        if not wants_on:
            self._note_off(now_ns, is_told=False)
        if self._asked_ns is not None and now_ns - self._asked_ns > self._times.answer_ns:
            return self._silence(now_ns - self._asked_ns, now_ns)
        return self._deviation(now_ns)

    def may_tell_on(self, *, held_at_ns: int | None) -> bool:
        """Whether on may be told: not before the newest off was told and read back.

        Else a line that sticks would go unseen, and a hold that came during a long exchange would be passed over.
        """
        if not self.tells_on:
            return not self.may_be_on
        return self._off_since_ns is None and (held_at_ns is None or held_at_ns < self._on_since_ns)

    def is_healthy(self, now_ns: int) -> bool:
        """Whether the line has answered well for some time, and is off."""
        return self._good_answers >= GOOD_ANSWERS and not self.is_silent(now_ns)

    def is_silent(self, now_ns: int) -> bool:
        """Whether the newest answer is older than any may be: nobody asks any more, or nobody looks."""
        return now_ns - self._answered_ns > int(DETECTION_MS * NS_PER_MS)

    def _note_off(self, now_ns: int, *, is_told: bool = True) -> None:
        if self.may_be_on and self._off_since_ns is None and not (is_told and self.tells_on):
            self._off_since_ns = now_ns

    def _follow(self, *, reads_on: bool, now_ns: int) -> None:
        """Take an answer as the proof of an order, where it is one."""
        if self.tells_on and reads_on and not self._was_read_on:
            self._was_read_on = True
            self.edges.append(ReadEdge(is_on=True, told_ns=self._on_since_ns, read_ns=now_ns))
        # A contact that was told on a moment ago and never read on may still be on its way there.
        has_arrived = self._was_read_on or now_ns - self._on_since_ns >= self._times.settle_ns
        if not self.tells_on and not reads_on and self.may_be_on and has_arrived:
            told_ns = now_ns if self._off_since_ns is None else self._off_since_ns
            self.edges.append(ReadEdge(is_on=False, told_ns=told_ns, read_ns=now_ns))
            self.may_be_on = False
            self._off_since_ns = None

    def _deviation(self, now_ns: int) -> Trouble | None:
        """Compare what is read with what is told, beyond the time that the line has to follow."""
        if self._off_since_ns is not None:
            return self._not_followed(self._off_since_ns, now_ns, "on", "off")
        if self.tells_on and not self.reads_on:
            return self._not_followed(self._on_since_ns, now_ns, "off", "on")
        if not self.tells_on and self.reads_on:
            return self._not_followed(now_ns - self._times.follow_ns - 1, now_ns, "on", "off")
        return None

    def _not_followed(self, since_ns: int, now_ns: int, reads: str, told: str) -> Trouble | None:
        if now_ns - since_ns <= self._times.follow_ns:
            return None
        self._good_answers = 0
        if told == "off" and (not self.reads_on or self._answered_ns < since_ns):
            detail = f"the beam line has not proved off {self._times.follow_ns / NS_PER_MS:.0f} ms after it was held"
            return Trouble(reason=HoldReason.BEAM_LINE_FAILED, detail=detail, at_ns=now_ns)
        detail = f"the beam line reads back {reads} though told {told}"
        return Trouble(reason=HoldReason.BEAM_LINE_MISMATCH, detail=detail, at_ns=now_ns)

    def _silence(self, waited_ns: int, now_ns: int) -> Trouble:
        self._good_answers = 0
        detail = f"the beam line has not answered for {waited_ns / NS_PER_MS:.0f} ms"
        return Trouble(reason=HoldReason.BEAM_LINE_FAILED, detail=detail, at_ns=now_ns)
