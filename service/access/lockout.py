"""How long nobody may try again: pure arithmetic; who has failed how often is in the store.

Counted for the name, whether anybody has it or not, and for the address. The first few cost nothing, each after that
doubles the wait up to a quarter of an hour, and an hour after the last failure it is forgotten.
"""

import math
from datetime import datetime, timedelta

from service.access.names import name_key
from service.access.records import Attempts

FREE_FOR_A_NAME = 5
FREE_FOR_AN_ADDRESS = 20
LONGEST = timedelta(minutes=15)
FORGOTTEN_AFTER = timedelta(hours=1)
MOST_SUBJECTS = 10_000


def name_subject(name: str) -> str:
    """Return what the failures of a name are counted under; as long as any name may be."""
    return f"name {name_key(name)[:160]}"


def address_subject(address: str) -> str:
    """Return what the failures of an address are counted under."""
    return f"address {address[:64]}"


def wait_s(attempts: Attempts | None, now: datetime) -> int:
    """Return how many whole seconds are left; 0 lets try."""
    if attempts is None or attempts.locked_until is None:
        return 0
    # A wall clock that was set back makes nobody wait for longer than the longest.
    left = min(attempts.locked_until - now, LONGEST)
    return max(0, math.ceil(left.total_seconds()))


def failed_again(attempts: Attempts | None, subject: str, now: datetime) -> Attempts:
    """Count one more failure."""
    is_old = attempts is None or is_forgotten(attempts, now)
    failures = 1 if attempts is None or is_old else attempts.failures + 1
    free = FREE_FOR_A_NAME if subject.startswith("name ") else FREE_FOR_AN_ADDRESS
    locked_until = now + _lock(failures - free) if failures >= free else None
    return Attempts(subject=subject, failures=failures, last_at=now, locked_until=locked_until)


def is_forgotten(attempts: Attempts, now: datetime) -> bool:
    """Whether it was so long ago that it counts no more."""
    return now - attempts.last_at > FORGOTTEN_AFTER and (attempts.locked_until is None or attempts.locked_until <= now)


def _lock(beyond: int) -> timedelta:
    return min(timedelta(seconds=2.0 ** min(beyond, 20)), LONGEST)
