"""Lock of a data folder: one program at a time, because two could drive one beam line differently.

The lock is advisory and the operating system's: it goes when its process ends, however that ends.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from engine.core.errors import TidegateError

LOCK_NAME = "tidegate.lock"
OWNER_ONLY = 0o700
"""A data folder holds patients' references and the hashes of passwords."""


class FolderInUseError(TidegateError):
    """Another Tidegate program uses this data folder, or the lock cannot be checked."""


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Have a data folder for oneself, made where it is missing; raise FolderInUseError where another has it."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=OWNER_ONLY)
        held = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        msg = f"the data folder {folder} cannot be locked: {error.strerror}"
        raise FolderInUseError(msg) from error
    try:
        _lock(held, folder)
        yield
    finally:
        os.close(held)


def _lock(held: int, folder: Path) -> None:
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        msg = f"the data folder {folder} is in use: a Tidegate service, or a check of its beam line, runs with it"
        raise FolderInUseError(msg) from error
