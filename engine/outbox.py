"""What leaves the engine for disk: three bounded queues that are never waited for.

A sample that finds its queue full is dropped and counted; a transition is kept here and offered again before anything
that came after it, and so is a notice of the learning. Each is trouble, and trouble holds the beam: what cannot be
recorded must not happen.
"""

import queue
import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

from engine.clock import NS_PER_MS
from engine.live import FrameRecord, GateTransition
from engine.notices import LearningNotice
from engine.permits import HoldReason
from engine.transition_journal import Journal, NoJournal

T = TypeVar("T")

RESERVED_TRANSITIONS = 4
"""Trouble is called while there is still room for the transitions it causes itself."""

NOTICE_CAPACITY = 64
"""A model takes ten seconds to learn and tells a handful of things: a queue that is full has no reader."""


class Outbox:
    """The engine's side of the recorder's and the audit's queue; transitions may come from the watchdog too."""

    def __init__(self, *, sample_capacity: int, transition_capacity: int, journal: Journal | None = None) -> None:
        self.samples: queue.Queue[FrameRecord] = queue.Queue(sample_capacity)
        self.transitions: queue.Queue[GateTransition] = queue.Queue(transition_capacity + RESERVED_TRANSITIONS)
        self.notices: queue.Queue[LearningNotice] = queue.Queue(NOTICE_CAPACITY)
        self.dropped_records = 0
        self._journal = journal or NoJournal()
        self._kept: deque[GateTransition] = deque()
        self._kept_notices: deque[LearningNotice] = deque()
        self._lock = threading.Lock()

    def put_sample(self, record: FrameRecord) -> None:
        """Queue a sample, or drop and count it."""
        try:
            self.samples.put_nowait(record)
        except queue.Full:
            self.dropped_records += 1

    def foresee(self, transition: GateTransition) -> int | None:
        """Keep, where a kill does not reach it, what the line is about to be told; returns its number."""
        with self._lock:
            return self._journal.foresee(transition)

    def forget(self, transition: GateTransition, number: int) -> None:
        """Take back what was foreseen and is not told as a transition."""
        with self._lock:
            self._journal.forget(transition, number)

    def put_transition(self, transition: GateTransition, *, settles: int | None = None) -> None:
        """Keep a transition where a kill does not reach it, and queue it behind those that still wait.

        ``settles`` is the number under which it was foreseen. The journal and the queue have one order.
        """
        with self._lock:
            number = self._journal.write(transition, settles=settles)
            self._kept.append(replace(transition, number=number))
        self.flush()

    def put_notices(self, notices: Iterable[LearningNotice]) -> None:
        """Queue what the learning has to tell, behind what still waits."""
        self._kept_notices.extend(notices)
        self.flush()

    def flush(self) -> None:
        """Offer again what found its queue full."""
        with self._lock:
            _offer(self._kept, self.transitions)
            _offer(self._kept_notices, self.notices)

    @property
    def kept_transitions(self) -> int:
        """How many transitions wait here because their queue is full."""
        return len(self._kept)

    def trouble(self) -> HoldReason | None:
        """Return why nothing more may happen, or None."""
        room = self.transitions.maxsize - self.transitions.qsize()
        if self._kept or self._kept_notices or room <= RESERVED_TRANSITIONS or self._journal.is_behind:
            return HoldReason.AUDIT_BEHIND
        return HoldReason.RECORDER_BEHIND if self.samples.full() else None

    def delay(self, now_ns: int, longest_ns: int) -> tuple[HoldReason, str] | None:
        """Return what has waited too long to be written down, and how long: a writer that hangs fills no queue soon.

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
                return reason, f"nothing was written for {(now_ns - since_ns) / NS_PER_MS:.0f} ms"
        return None


def _first(filled: "queue.Queue[T]") -> T | None:
    """Look at what waits first; its reader may take it at any time."""
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
