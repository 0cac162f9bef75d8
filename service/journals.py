"""Where the transitions' journals lie: in memory that outlives the process, one file a session.

The file's name begins with a digest of the data folder: several services may share the memory of one machine, and each
finds its own. docs/adr/0012 says why memory, and when not.
"""

import fcntl
import hashlib
import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from engine.clock import Clock, MonotonicClock
from engine.transition_journal import JournalError, TransitionJournal

logger = logging.getLogger(__name__)

MEMORY = Path("/dev/shm")  # noqa: S108 - made with O_EXCL, 0600, read only where it is our own # nosec B108
FOLDER = "journal"
SUFFIX = ".journal"
DIGEST_CHARACTERS = 16
PATIENCE_S = 5.0
"""An engine without a service ends within a frame; one that hangs is given up by itself after three seconds."""
LOOK_S = 0.05


class Journals:
    """Makes journals for sessions, and finds those that a killed process left."""

    def __init__(self, data_dir: Path, folder: Path | None, *, memory: Path | None = None) -> None:
        self._in_data = data_dir / FOLDER
        self._memory = memory or MEMORY
        self._told = folder
        digest = hashlib.sha256(str(data_dir.resolve()).encode()).hexdigest()[:DIGEST_CHARACTERS]
        self._prefix = f"tidegate-{digest}-"

    @property
    def folder(self) -> Path:
        """Where a journal is made: where told and nowhere else; in memory; with the data, also for want of room."""
        if self._told is not None:
            return self._told
        return self._memory if self._has_memory else self._in_data

    @property
    def _has_memory(self) -> bool:
        return os.access(self._memory, os.W_OK | os.X_OK)

    def begin(self, session_id: str, clock: Clock | None = None) -> TransitionJournal:
        """Make a session's journal; raise JournalError where that cannot be: memory may be full, and the disk too."""
        if self._told is not None:
            return self._made(self._told, session_id, clock)
        reason = f"{self._memory} cannot be written to"
        if self._has_memory:
            try:
                return self._made(self._memory, session_id, clock)
            except JournalError as error:
                reason = str(error)
        logger.warning("transitions are kept in %s, where a write may wait for a disk: %s", self._in_data, reason)
        return self._made(self._in_data, session_id, clock)

    def _made(self, folder: Path, session_id: str, clock: Clock | None) -> TransitionJournal:
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            msg = f"transitions cannot be kept safe from a kill: {error.strerror}"
            raise JournalError(msg) from error
        path = folder / f"{self._prefix}{session_id}{SUFFIX}"
        return TransitionJournal(path, session_id=session_id, clock=clock or MonotonicClock())

    @contextmanager
    def begun(self, session_id: str) -> Iterator[TransitionJournal]:
        """Make one for a session that is about to begin; it is closed where that fails."""
        journal = self.begin(session_id)
        try:
            yield journal
        except BaseException:
            journal.close()
            raise

    def left_behind(self) -> Iterator[Path]:
        """Find the files that a process before this one left, wherever it was told to make them."""
        folders = {folder.resolve() for folder in (self._told, self._memory, self._in_data) if folder is not None}
        for folder in sorted(folders):
            for path in sorted(folder.glob(f"{self._prefix}*{SUFFIX}")):
                if path.is_file() and not path.is_symlink() and path.stat().st_uid == os.geteuid():
                    yield path

    def session_of(self, path: Path) -> str:
        """Say which session a file is of, by its name."""
        return path.name.removeprefix(self._prefix).removesuffix(SUFFIX)


def is_let_go(path: Path) -> bool:
    """Whether nobody writes to a journal, within the patience."""
    return read_unless_in_use(path) is not None


def read_unless_in_use(path: Path, *, patience_s: float | None = None) -> bytes | None:
    """Read a journal that nobody writes to; None where another process still does after a while.

    The engine of a service that was killed has heard so, and is on its way out.
    """
    file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with os.fdopen(file, "rb") as opened:
        end_s = time.monotonic() + (PATIENCE_S if patience_s is None else patience_s)
        while not _is_free(opened):
            if time.monotonic() >= end_s:
                return None
            time.sleep(LOOK_S)
        return opened.read()


def _is_free(opened: BinaryIO) -> bool:
    try:
        fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
