"""What leaves the engine for disk: two bounded queues that are never waited for.

A sample that finds its queue full is dropped and counted; a transition is kept here and offered again before anything
that came after it. Either is trouble, and trouble holds the beam: what cannot be recorded must not happen.
"""

import queue
import threading
from collections import deque

from engine.live import FrameRecord, GateTransition
from engine.permits import HoldReason

RESERVED_TRANSITIONS = 4
"""Trouble is called while there is still room for the transitions it causes itself."""


class Outbox:
    """The engine's side of the recorder's and the audit's queue; transitions may come from the watchdog too."""

    def __init__(self, *, sample_capacity: int, transition_capacity: int) -> None:
        self.samples: queue.Queue[FrameRecord] = queue.Queue(sample_capacity)
        self.transitions: queue.Queue[GateTransition] = queue.Queue(transition_capacity + RESERVED_TRANSITIONS)
        self.dropped_records = 0
        self._kept: deque[GateTransition] = deque()
        self._lock = threading.Lock()

    def put_sample(self, record: FrameRecord) -> None:
        """Queue a sample, or drop and count it."""
        try:
            self.samples.put_nowait(record)
        except queue.Full:
            self.dropped_records += 1

    def put_transition(self, transition: GateTransition) -> None:
        """Queue a transition behind those that still wait."""
        self._kept.append(transition)
        self.flush()

    def flush(self) -> None:
        """Offer again what found the queue full."""
        with self._lock:
            while self._kept:
                try:
                    self.transitions.put_nowait(self._kept[0])
                except queue.Full:
                    return
                self._kept.popleft()

    @property
    def kept_transitions(self) -> int:
        """How many transitions wait here because their queue is full."""
        return len(self._kept)

    def trouble(self) -> HoldReason | None:
        """Return why nothing more may happen, or None."""
        room = self.transitions.maxsize - self.transitions.qsize()
        if self._kept or room <= RESERVED_TRANSITIONS:
            return HoldReason.AUDIT_BEHIND
        return HoldReason.RECORDER_BEHIND if self.samples.full() else None
