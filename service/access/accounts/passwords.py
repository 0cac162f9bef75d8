"""Password rules and hashing: argon2id, 19 MiB, 3 passes, one lane.

One lane, one password at a time and a pause after each (`PasswordService`): a verification occupies a core for some
30 ms by design, and the gate runs on the same machine. The thread has normal priority, because a thread of lower
priority could hold the interpreter or database lock while it is not scheduled, and so delay the engine. The parameters
are OWASP's second memory choice with one more pass; hashes with other parameters are replaced at the next log-in.
"""

import functools
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol, TypeVar

from argon2 import PasswordHasher, Type
from argon2.exceptions import InvalidHashError, VerificationError

from service.access.accounts.records import name_key
from service.core.errors import BoundError, PasswordServiceBusyError

MIN_LENGTH = 12
MAX_LENGTH = 256
TIME_COST = 3
MEMORY_KIB = 19_456
LANES = 1
PAUSE_S = 0.1
MAX_QUEUED = 8
ResultT = TypeVar("ResultT")


class Hashing(Protocol):
    """Hashes and verifies passwords; an implementation may take tens of milliseconds."""

    def hash(self, password: str) -> str:
        """Return the encoded hash with a new random salt."""

    def verify(self, hashed: str | None, password: str) -> bool:
        """Whether the password matches; for None, an account without a password, False after the same time."""

    def is_outdated(self, hashed: str) -> bool:
        """Whether the hash has other parameters than the current ones."""


class Argon2Hashing:
    """Argon2id of `argon2-cffi`, which releases the interpreter lock while it computes."""

    def __init__(self) -> None:
        self._hasher = _hasher()
        self._dummy_hash = _dummy_hash()

    def hash(self, password: str) -> str:
        """Return the encoded hash with a new random salt."""
        return self._hasher.hash(password)

    def verify(self, hashed: str | None, password: str) -> bool:
        """Whether the password matches; always verifies exactly one hash, a dummy one for None."""
        try:
            is_right = self._hasher.verify(self._dummy_hash if hashed is None else hashed, password)
        except (VerificationError, InvalidHashError):
            return False
        return is_right and hashed is not None

    def is_outdated(self, hashed: str) -> bool:
        """Whether the hash has other parameters than the current ones."""
        return self._hasher.check_needs_rehash(hashed)


def check_password(password: str, name: str) -> None:
    """Raise BoundError for a password that is too short, too long or the name; the error does not contain it."""
    bound = f"{MIN_LENGTH} to {MAX_LENGTH} characters, and not the name"
    if not MIN_LENGTH <= len(password) <= MAX_LENGTH or name_key(password) == name_key(name):
        msg = f"the password must be {bound}"
        raise BoundError(msg, field="password", bound=bound)


class PasswordService:
    """Runs password work one at a time in its own thread, with a pause [s] after each."""

    def __init__(self, *, max_queued: int = MAX_QUEUED, pause_s: float = PAUSE_S) -> None:
        self._pool = ThreadPoolExecutor(1, "password-check")
        self._slots = threading.BoundedSemaphore(max_queued)
        self._pause_s = pause_s
        self._is_closed = threading.Event()
        self._paused_until_s = 0.0

    def submit(self, work: Callable[[], ResultT]) -> "Future[ResultT]":
        """Queue a call and return its future; raise PasswordServiceBusyError if the queue is full or closed."""
        if not self._slots.acquire(blocking=False):
            msg = "too many log-ins at once: try again in a second"
            raise PasswordServiceBusyError(msg)
        try:
            future = self._pool.submit(self._work, work)
        except RuntimeError as error:
            self._slots.release()
            raise PasswordServiceBusyError("the service is stopping") from error
        future.add_done_callback(lambda _: self._slots.release())
        return future

    def close(self) -> None:
        """Cancel queued calls, wait for the running one and end the thread."""
        self._is_closed.set()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _work(self, work: Callable[[], ResultT]) -> ResultT:
        self._is_closed.wait(max(0.0, self._paused_until_s - time.monotonic()))
        try:
            return work()
        finally:
            self._paused_until_s = time.monotonic() + self._pause_s


def _hasher() -> PasswordHasher:
    return PasswordHasher(
        time_cost=TIME_COST, memory_cost=MEMORY_KIB, parallelism=LANES, hash_len=32, salt_len=16, type=Type.ID
    )


@functools.cache
def _dummy_hash() -> str:
    return _hasher().hash("the password of no account")
