"""Passwords: which are taken, and how they are kept: argon2id, 19 MiB, 3 passes, one lane.

One lane, one password at a time, and a rest after each (`PasswordDesk`): checking a password costs a core for some
30 ms by design, and the gate runs on the same machine. The thread has the priority of all others: one of a lower would
keep the interpreter, or the database, from the engine for as long as it is not let run. The numbers are OWASP's second
choice of memory with one pass more; whoever's hash was made with others gets a new one at the next log-in.
"""

import functools
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol, TypeVar

from argon2 import PasswordHasher, Type
from argon2.exceptions import InvalidHashError, VerificationError

from service.access.names import name_key
from service.errors import BoundError, PasswordDeskFullError

MIN_LENGTH = 12
MAX_LENGTH = 256
TIME_COST = 3
MEMORY_KIB = 19_456
LANES = 1
REST_S = 0.1
LONGEST_QUEUE = 8
ResultT = TypeVar("ResultT")


class Hashing(Protocol):
    """Makes and checks the hashes of passwords."""

    def hash(self, password: str) -> str:
        """Make a hash with a salt of its own."""

    def verify(self, hashed: str | None, password: str) -> bool:
        """Compare; None, which nobody has set, takes as long and is never right."""

    def is_outdated(self, hashed: str) -> bool:
        """Whether it was made with other parameters than today's."""


class Argon2Hashing:
    """Argon2id as `argon2-cffi` has it; lets go of the interpreter while it works."""

    def __init__(self) -> None:
        self._hasher = _hasher()
        self._nobody = _nobody()

    def hash(self, password: str) -> str:
        """Make a hash with a salt of its own."""
        return self._hasher.hash(password)

    def verify(self, hashed: str | None, password: str) -> bool:
        """Compare, once, whoever is asked about."""
        try:
            is_right = self._hasher.verify(self._nobody if hashed is None else hashed, password)
        except (VerificationError, InvalidHashError):
            return False
        return is_right and hashed is not None

    def is_outdated(self, hashed: str) -> bool:
        """Whether it was made with other parameters than today's."""
        return self._hasher.check_needs_rehash(hashed)


def check_password(password: str, name: str) -> None:
    """Refuse a password that is too short, too long, or the name; says nothing of what it is."""
    bound = f"{MIN_LENGTH} to {MAX_LENGTH} characters, and not the name"
    if not MIN_LENGTH <= len(password) <= MAX_LENGTH or name_key(password) == name_key(name):
        msg = f"the password must be {bound}"
        raise BoundError(msg, field="password", bound=bound)


class PasswordDesk:
    """Checks passwords one after the other, with a rest between, on a thread of its own."""

    def __init__(self, *, longest_queue: int = LONGEST_QUEUE, rest_s: float = REST_S) -> None:
        self._pool = ThreadPoolExecutor(1, "password-desk")
        self._places = threading.BoundedSemaphore(longest_queue)
        self._rest_s = rest_s
        self._is_closed = threading.Event()
        self._rested_at_s = 0.0

    def submit(self, work: Callable[[], ResultT]) -> "Future[ResultT]":
        """Queue a piece of work; raise PasswordDeskFullError where too many wait already."""
        if not self._places.acquire(blocking=False):
            msg = "too many log-ins at once: try again in a second"
            raise PasswordDeskFullError(msg)
        try:
            future = self._pool.submit(self._work, work)
        except RuntimeError as error:
            self._places.release()
            raise PasswordDeskFullError("the service is stopping") from error
        future.add_done_callback(lambda _: self._places.release())
        return future

    def close(self) -> None:
        """End the thread; what waits is cancelled."""
        self._is_closed.set()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _work(self, work: Callable[[], ResultT]) -> ResultT:
        self._is_closed.wait(max(0.0, self._rested_at_s - time.monotonic()))
        try:
            return work()
        finally:
            self._rested_at_s = time.monotonic() + self._rest_s


def _hasher() -> PasswordHasher:
    return PasswordHasher(
        time_cost=TIME_COST, memory_cost=MEMORY_KIB, parallelism=LANES, hash_len=32, salt_len=16, type=Type.ID
    )


@functools.cache
def _nobody() -> str:
    return _hasher().hash("a password that nobody has")
