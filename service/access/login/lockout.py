"""Lockout after failed log-ins, as pure functions; the failure counts are in the store.

Failures are counted per name, whether or not the account exists, and per client address. The first few cause no wait;
each further one doubles the wait, up to 15 minutes. A count lapses an hour after the last failure.
"""

import math
from datetime import datetime, timedelta

from service.access.accounts.names import name_key
from service.access.accounts.records import Attempts

FREE_PER_NAME = 5
FREE_PER_ADDRESS = 20
MAX_WAIT = timedelta(minutes=15)
LAPSES_AFTER = timedelta(hours=1)
MAX_SUBJECTS = 10_000


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
