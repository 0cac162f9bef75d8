"""Journals of gate transitions: one file per session, in memory that survives the process.

The file's name begins with a digest of the data folder, so that several services on one machine find their own files.
docs/adr/0012 gives the reason for memory, and when a disk is used.
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

from engine.control import JournalError, TransitionJournal
from engine.core.clock import Clock, MonotonicClock

logger = logging.getLogger(__name__)

MEMORY = Path("/dev/shm")  # noqa: S108 - made with O_EXCL, 0600, read only where it is our own # nosec B108
FOLDER = "journal"
SUFFIX = ".journal"
DIGEST_CHARACTERS = 16
PATIENCE_S = 5.0
"""Wait for a journal in use [s]: an engine without a service ends within a frame, a hanging one after three seconds."""
LOOK_S = 0.05


class Journals:
    """Creates journals for sessions, and finds those of a killed process."""

    def __init__(self, data_dir: Path, folder: Path | None, *, memory: Path | None = None) -> None:
        self._in_data = data_dir / FOLDER
        self._memory = memory or MEMORY
        self._configured = folder
        digest = hashlib.sha256(str(data_dir.resolve()).encode()).hexdigest()[:DIGEST_CHARACTERS]
        self._prefix = f"tidegate-{digest}-"

    @property
    def folder(self) -> Path:
        """Where journals are created: the configured folder, else memory, else the data folder."""
        if self._configured is not None:
            return self._configured
        return self._memory if self._has_memory else self._in_data

    @property
    def _has_memory(self) -> bool:
        return os.access(self._memory, os.W_OK | os.X_OK)

    def begin(self, session_id: str, clock: Clock | None = None) -> TransitionJournal:
        """Create a session's journal; raise JournalError where neither memory nor disk can hold it."""
        if self._configured is not None:
            return self._create(self._configured, session_id, clock)
        reason = f"{self._memory} cannot be written to"
        if self._has_memory:
            try:
                return self._create(self._memory, session_id, clock)
            except JournalError as error:
                reason = str(error)
        logger.warning("transitions are kept in %s, where a write may wait for a disk: %s", self._in_data, reason)
        return self._create(self._in_data, session_id, clock)

    def _create(self, folder: Path, session_id: str, clock: Clock | None) -> TransitionJournal:
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            msg = f"transitions cannot be kept safe from a kill: {error.strerror}"
            raise JournalError(msg) from error
        path = folder / f"{self._prefix}{session_id}{SUFFIX}"
        return TransitionJournal(path, session_id=session_id, clock=clock or MonotonicClock())

    @contextmanager
    def begun(self, session_id: str) -> Iterator[TransitionJournal]:
        """Create one for a session that is starting, and close it if the start fails."""
        journal = self.begin(session_id)
        try:
            yield journal
        except BaseException:
            journal.close()
            raise

    def left_behind(self) -> Iterator[Path]:
        """Find the files of an earlier process in every folder that it may have used."""
        folders = {folder.resolve() for folder in (self._configured, self._memory, self._in_data) if folder is not None}
        for folder in sorted(folders):
            for path in sorted(folder.glob(f"{self._prefix}*{SUFFIX}")):
                if path.is_file() and not path.is_symlink() and path.stat().st_uid == os.geteuid():
                    yield path

    def session_of(self, path: Path) -> str:
        """Return the session id in a file name."""
        return path.name.removeprefix(self._prefix).removesuffix(SUFFIX)


def is_let_go(path: Path) -> bool:
    """Whether no process has the journal open for writing, within the waiting time."""
    return read_unless_in_use(path) is not None


def read_unless_in_use(path: Path, *, patience_s: float | None = None) -> bytes | None:
    """Read a journal that no process writes to; None where one still does after ``patience_s``.

    The engine of a killed service notices its end and stops within that time.
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
