"""Lockout after failed log-ins, as pure functions; the failure counts are in the store.

Failures are counted per name, whether or not the account exists, and per client address. The first few cause no wait;
each further one doubles the wait, up to 15 minutes. A count lapses an hour after the last failure.

Refusals waiting for the audit: one row for each refusal of an identified sender, counts for the others.

Requests never wait for the audit. Audit rows are permanent and take the write lock that the gate's own rows need, so
their number is bounded: all unidentified senders together cost one summary row a minute, an identified sender at most
`MAX_PER_MINUTE` rows of each kind; what exceeds that is counted.
"""

import math
import threading
from collections import Counter
from datetime import datetime, timedelta

from service.access.accounts.records import Attempts, name_key
from service.storage.audit import SYSTEM, Event

FREE_PER_NAME = 5
FREE_PER_ADDRESS = 20
MAX_WAIT = timedelta(minutes=15)
LAPSES_AFTER = timedelta(hours=1)
MAX_SUBJECTS = 10_000
MAX_QUEUED = 256
MAX_PER_MINUTE = 10
"""Rows of one kind for one person or machine between two summaries."""
MAX_ADDRESSES = 8
REFUSED = "access.refused"


def name_subject(name: str) -> str:
    """Return the key of a name's failure count; cut, since any text can be sent as a name."""
    return f"name {name_key(name)[:160]}"


def address_subject(address: str) -> str:
    """Return the key of an address's failure count."""
    return f"address {address[:64]}"


def wait_s(attempts: Attempts | None, now: datetime) -> int:
    """Return the remaining wait in whole seconds, rounded up; 0 if a log-in may be tried."""
    if attempts is None or attempts.locked_until is None:
        return 0
    # Bounded, so that a clock that was set back cannot lengthen the wait.
    left = min(attempts.locked_until - now, MAX_WAIT)
    return max(0, math.ceil(left.total_seconds()))


def failed_again(attempts: Attempts | None, subject: str, now: datetime) -> Attempts:
    """Return the count with one more failure at ``now``; a lapsed count starts again at one."""
    is_old = attempts is None or has_lapsed(attempts, now)
    failures = 1 if attempts is None or is_old else attempts.failures + 1
    free = FREE_PER_NAME if subject.startswith("name ") else FREE_PER_ADDRESS
    locked_until = now + _lock(failures - free) if failures >= free else None
    return Attempts(subject=subject, failures=failures, last_at=now, locked_until=locked_until)


def has_lapsed(attempts: Attempts, now: datetime) -> bool:
    """Whether the last failure is too old to count, and no lock is running."""
    return now - attempts.last_at > LAPSES_AFTER and (attempts.locked_until is None or attempts.locked_until <= now)


def _lock(beyond: int) -> timedelta:
    return min(timedelta(seconds=2.0 ** min(beyond, 20)), MAX_WAIT)


class RefusedLogins:
    """Queue and counters, filled from any thread, drained by `AccessCleanupWorker`; ``total`` is never reset."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._events: list[Event] = []
        self._counts: Counter[str] = Counter()
        self._addresses: Counter[str] = Counter()
        self._noted: Counter[tuple[str, str]] = Counter()
        self.total: Counter[str] = Counter()

    def count(self, what: str, address: str) -> None:
        """Count a refusal of an unidentified sender, and its address."""
        with self._lock:
            self.total[what] += 1
            self._counts[what] += 1
            if address in self._addresses or len(self._addresses) < MAX_ADDRESSES:
                self._addresses[address] += 1

    def record(self, event: Event) -> None:
        """Queue a refusal of an identified sender; count it instead where the limit is reached."""
        with self._lock:
            self.total[event.action] += 1
            self._noted[event.actor, event.action] += 1
            if self._noted[event.actor, event.action] > MAX_PER_MINUTE:
                self._counts[f"{event.action} of {event.actor}"] += 1
            elif len(self._events) < MAX_QUEUED:
                self._events.append(event)
            else:
                self._counts["beyond the queue"] += 1

    def take_events(self) -> list[Event]:
        """Remove and return the queued rows."""
        with self._lock:
            taken, self._events = self._events, []
        return taken

    def requeue(self, events: list[Event]) -> None:
        """Queue rows again that could not be written; what exceeds the queue is counted."""
        with self._lock:
            room = max(0, MAX_QUEUED - len(self._events))
            self._events = events[:room] + self._events
            self._counts["beyond the queue"] += max(0, len(events) - room)

    def take_summary(self) -> Event | None:
        """Return the counts as one audit row and reset them; None if all are zero."""
        with self._lock:
            counts, addresses = dict(self._counts), dict(self._addresses)
            self._counts.clear()
            self._addresses.clear()
            self._noted.clear()
        if not counts:
            return None
        detail = {"counts": counts, "addresses": addresses}
        return Event(actor=SYSTEM, action=REFUSED, outcome="refused", detail=detail)
