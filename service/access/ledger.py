"""What was refused, on its way to the audit: one row for each that somebody known was refused, a count of the rest.

Nobody waits for the audit here: a flood of strangers costs one row a minute, and of somebody known a few rows a minute
of each kind are kept, and the rest counted. Rows are for ever, and take the lock that the gate's own rows wait for.
"""

import threading
from collections import Counter

from service.audit import SYSTEM, Event

LONGEST_QUEUE = 256
MOST_A_MINUTE = 10
"""Rows of one kind about one person or machine, between two summaries."""
MOST_ADDRESSES = 8
REFUSED = "access.refused"


class RefusalLedger:
    """Gathers refusals from any thread; the keeper takes them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._events: list[Event] = []
        self._counts: Counter[str] = Counter()
        self._addresses: Counter[str] = Counter()
        self._noted: Counter[tuple[str, str]] = Counter()
        self.total: Counter[str] = Counter()

    def count(self, what: str, address: str) -> None:
        """Count a refusal of somebody unknown."""
        with self._lock:
            self.total[what] += 1
            self._counts[what] += 1
            if address in self._addresses or len(self._addresses) < MOST_ADDRESSES:
                self._addresses[address] += 1

    def note(self, event: Event) -> None:
        """Keep a refusal of somebody known."""
        with self._lock:
            self.total[event.action] += 1
            self._noted[event.actor, event.action] += 1
            if self._noted[event.actor, event.action] > MOST_A_MINUTE:
                self._counts[f"{event.action} of {event.actor}"] += 1
            elif len(self._events) < LONGEST_QUEUE:
                self._events.append(event)
            else:
                self._counts["beyond the queue"] += 1

    def take_events(self) -> list[Event]:
        """Hand over the rows that are due."""
        with self._lock:
            taken, self._events = self._events, []
        return taken

    def give_back(self, events: list[Event]) -> None:
        """Take back what could not be written, as far as there is room."""
        with self._lock:
            room = max(0, LONGEST_QUEUE - len(self._events))
            self._events = events[:room] + self._events
            self._counts["beyond the queue"] += max(0, len(events) - room)

    def take_summary(self) -> Event | None:
        """Hand over the counts as one row; None where nothing was refused."""
        with self._lock:
            counts, addresses = dict(self._counts), dict(self._addresses)
            self._counts.clear()
            self._addresses.clear()
            self._noted.clear()
        if not counts:
            return None
        detail = {"counts": counts, "addresses": addresses}
        return Event(actor=SYSTEM, action=REFUSED, outcome="refused", detail=detail)
