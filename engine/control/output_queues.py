"""The engine's output to the disk: three bounded queues that the engine never waits for.

A sample is dropped and counted where its queue is full. A transition or a learning event is kept and offered again, in
order. Each of these holds the beam: the beam may be on only while it can be recorded.
"""

import queue
import threading
from collections import deque
from collections.abc import Iterable
from typing import TypeVar

from engine.control.journal.journal import Journal, NoJournal
from engine.control.outputs import FrameRecord, GateTransition
from engine.core.clock import NS_PER_MS
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningEvent
from engine.core.replacing import replace
from engine.core.sentences import say

T = TypeVar("T")

RESERVED_TRANSITIONS = 4
"""Places kept free: the fault of a full queue causes transitions of its own."""

NOTICE_CAPACITY = 64
"""A model takes ten seconds to learn and makes a handful of events: a full queue has no reader."""


class OutputQueues:
    """The queues of samples, transitions and learning events; the watchdog's thread puts transitions too."""

    def __init__(self, *, sample_capacity: int, transition_capacity: int, journal: Journal | None = None) -> None:
        self.samples: queue.Queue[FrameRecord] = queue.Queue(sample_capacity)
        self.transitions: queue.Queue[GateTransition] = queue.Queue(transition_capacity + RESERVED_TRANSITIONS)
        self.notices: queue.Queue[LearningEvent] = queue.Queue(NOTICE_CAPACITY)
        self.dropped_records = 0
        self._journal = journal or NoJournal()
        self._kept: deque[GateTransition] = deque()
        self._kept_notices: deque[LearningEvent] = deque()
        self._lock = threading.Lock()

    def put_sample(self, record: FrameRecord) -> None:
        """Queue a sample, or drop and count it."""
        try:
            self.samples.put_nowait(record)
        except queue.Full:
            self.dropped_records += 1

    def prepare(self, transition: GateTransition) -> int | None:
        """Write a permit to the journal before the line is ordered; return its number."""
        with self._lock:
            return self._journal.prepare(transition)

    def abort(self, transition: GateTransition, number: int) -> None:
        """Cancel the journal's prepared entry ``number``."""
        with self._lock:
            self._journal.abort(transition, number)

    def put_transition(self, transition: GateTransition, *, prepared: int | None = None) -> None:
        """Commit a transition to the journal, and queue it behind those that still wait.

        ``prepared`` is the number of its prepared entry. The journal and the queue have the same order.
        """
        with self._lock:
            number = self._journal.commit(transition, prepared=prepared)
            self._kept.append(replace(transition, number=number))
        self.flush()

    def put_notices(self, notices: Iterable[LearningEvent]) -> None:
        """Queue learning events behind those that still wait."""
        self._kept_notices.extend(notices)
        self.flush()

    def flush(self) -> None:
        """Offer again what did not fit into its queue."""
        with self._lock:
            _offer(self._kept, self.transitions)
            _offer(self._kept_notices, self.notices)

    @property
    def kept_transitions(self) -> int:
        """Number of transitions that did not fit into their queue."""
        return len(self._kept)

    def trouble(self) -> HoldReason | None:
        """Return why the beam has to be held: a queue or the journal is full. None where neither is."""
        free = self.transitions.maxsize - self.transitions.qsize()
        if self._kept or self._kept_notices or free <= RESERVED_TRANSITIONS or self._journal.is_behind:
            return HoldReason.AUDIT_BEHIND
        return HoldReason.RECORDER_BEHIND if self.samples.full() else None

    def delay(self, now_ns: int, longest_ns: int) -> tuple[HoldReason, str] | None:
        """Return what has waited too long for the disk, and how long: a writer that hangs fills a queue only slowly.

        Parameters
        ----------
        now_ns, longest_ns
            Host monotonic time, and the longest a transition or a sample may wait [ns].
        """
        transition, sample = _first(self.transitions), _first(self.samples)
        for reason, since_ns in (
            (HoldReason.AUDIT_BEHIND, None if transition is None else transition.at_ns),
            (HoldReason.RECORDER_BEHIND, None if sample is None else sample.asserted_ns),
        ):
            if since_ns is not None and now_ns - since_ns > longest_ns:
                return reason, say(
                    "nothing was written for {silent_ms:.0f} ms", silent_ms=(now_ns - since_ns) / NS_PER_MS
                )
        return None


def _first(filled: "queue.Queue[T]") -> T | None:
    """Return the first waiting item; its reader may take it at any time."""
    try:
        first: T = filled.queue[0]
    except IndexError:
        return None
    return first


def _offer(kept: deque[T], target: "queue.Queue[T]") -> None:
    while kept:
        try:
            target.put_nowait(kept[0])
        except queue.Full:
            return
        kept.popleft()
