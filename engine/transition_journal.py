"""Every transition in memory that outlives this process, before or as it happens: kill -9 loses none.

A ring of slots in a mapped file, made and touched before the session begins. Writing one copies a kilobyte: no call to
the system, no lock, no wait. A permit is written before the line hears of it; a hold right after, for nothing may stand
in a hold's way. The audit confirms what it has committed; a ring about to overwrite what it has not is trouble.
"""

import fcntl
import mmap
import os
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from engine.clock import Clock
from engine.errors import TidegateError
from engine.journal_slots import (
    JournalHeader,
    NotAJournalError,
    pack_slot,
    pack_void,
    place_of,
    read_header,
    size_of,
)
from engine.live import GateTransition

SLOTS = 2048
RESERVED_SLOTS = 64
"""Trouble is called while there is still room for what it causes itself."""

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class JournalError(TidegateError):
    """Transitions could not be kept safe from a kill."""

    code = "journal_unavailable"


class Journal(Protocol):
    """Where transitions are kept until the audit has them."""

    @property
    def is_behind(self) -> bool:
        """Whether the audit has left too many unconfirmed."""

    def foresee(self, transition: GateTransition) -> int | None:
        """Keep what is about to be told to the line; returns its number."""

    def write(self, transition: GateTransition, *, settles: int | None = None) -> int | None:
        """Keep what was told; ``settles`` is what was foreseen of it. Returns its number."""

    def forget(self, transition: GateTransition, number: int) -> None:
        """Take back what was foreseen and became nothing."""


class NoJournal:
    """Keeps nothing: for runs that no audit is made of."""

    is_behind = False

    def foresee(self, transition: GateTransition) -> int | None:  # noqa: ARG002 - the protocol's
        """Keep nothing."""
        return None

    def write(self, transition: GateTransition, *, settles: int | None = None) -> int | None:  # noqa: ARG002 - the protocol's
        """Keep nothing."""
        return None

    def forget(self, transition: GateTransition, number: int) -> None:
        """Keep nothing."""


class LentJournal:
    """A journal that another process writes, as the process sees it that made it and keeps the audit."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.confirmed = 0
        self._newest_told: int | None = None

    def confirm(self, number: int) -> None:
        """Hear from the audit; the writer is told with the next word that it gets."""
        self.confirmed = max(self.confirmed, number)

    def returned(self, newest_told: int) -> None:
        """Hear from its writer, at its end, the number of the last transition that it told."""
        self._newest_told = newest_told

    @property
    def is_orphaned(self) -> bool:
        """Whether its writer never said how far it came."""
        return self._newest_told is None

    def close(self) -> None:
        """Remove the file where the audit has all of it; else it is read again."""
        if self._newest_told is not None and self.confirmed >= self._newest_told:
            self.path.unlink(missing_ok=True)


class TransitionJournal:
    """One session's ring; its callers see to it that only one of them writes at a time."""

    def __init__(self, path: Path, *, session_id: str, clock: Clock, slots: int = SLOTS) -> None:
        self.path = path
        self._slots = slots
        self._number = 0
        self._newest_told = 0
        self._confirmed = 0
        self._lent: LentJournal | None = None
        header = JournalHeader(
            session_id=session_id,
            boot_id=boot_id(),
            anchor_utc_us=round(datetime.now(UTC).timestamp() * 1e6),
            anchor_ns=clock.now_ns(),
            slots=slots,
        )
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise _unavailable(error) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # gone with this process, however it ends
            self._ring: mmap.mmap | None = _mapped(self._file, header)
        except OSError as error:
            path.unlink(missing_ok=True)
            os.close(self._file)
            raise _unavailable(error) from error

    def lend(self, hand_over: Callable[[int], None]) -> LentJournal:
        """Let another process write: ``hand_over`` gives it the open file, and the lock stays where the file is."""
        ring, self._ring = self._ring, None
        if ring is None:
            msg = "a journal that is closed cannot be handed over"
            raise JournalError(msg)
        ring.close()
        self._lent = LentJournal(self.path)
        try:
            hand_over(self._file)
        finally:
            os.close(self._file)
        return self._lent

    @property
    def newest_told(self) -> int:
        """The number of the last transition that was told."""
        return self._newest_told

    @property
    def is_behind(self) -> bool:
        """Whether the next writes would come near what the audit has not confirmed."""
        return self._number - self._confirmed > self._slots - RESERVED_SLOTS

    @property
    def is_confirmed(self) -> bool:
        """Whether the audit has everything that was told."""
        return self._confirmed >= self._newest_told

    def foresee(self, transition: GateTransition) -> int | None:
        """Keep what is about to be told to the line."""
        self._number += 1
        self._put(self._number, pack_slot(self._number, transition, settles=0, is_told=False))
        return self._number

    def write(self, transition: GateTransition, *, settles: int | None = None) -> int | None:
        """Keep what was told."""
        self._number += 1
        self._put(self._number, pack_slot(self._number, transition, settles=settles or 0, is_told=True))
        self._newest_told = self._number
        return self._number

    def forget(self, transition: GateTransition, number: int) -> None:
        """Take back what was foreseen."""
        self._number += 1
        self._put(self._number, pack_void(self._number, transition, settles=number))

    def confirm(self, number: int) -> None:
        """Hear from the audit that it has everything up to this number."""
        self._confirmed = max(self._confirmed, number)
        if self._lent is not None:
            self._lent.confirm(number)

    @property
    def is_orphaned(self) -> bool:
        """Whether another process wrote it, and ended without saying what: the file alone knows."""
        return self._lent is not None and self._lent.is_orphaned

    def close(self) -> None:
        """Write no more; the file is removed when the audit has all of it, else the next start reads it."""
        ring, self._ring = self._ring, None
        if ring is None:
            if self._lent is not None:
                self._lent.close()
            return
        if self.is_confirmed:
            self.path.unlink(missing_ok=True)
        with suppress(BufferError):
            ring.close()
        os.close(self._file)

    def _put(self, number: int, slot: bytes) -> None:
        ring = self._ring
        if ring is None:
            return
        at = place_of(number, self._slots)
        ring[at : at + len(slot)] = slot


class BorrowedJournal(TransitionJournal):
    """One that another process has made and nobody has written to; its lock has come with its open file.

    It is for that process to remove the file.

    Raises
    ------
    JournalError
        The file is no journal.
    """

    def __init__(self, file: int) -> None:
        self.path, self._file = Path(), file
        self._number = self._newest_told = self._confirmed = 0
        self._lent = None
        try:
            ring = mmap.mmap(file, 0)
            self._slots = read_header(ring[:]).slots
            for at in range(0, size_of(self._slots), mmap.PAGESIZE):
                ring[at] = ring[at]  # as where it was made: no write of a transition may have to ask for a page
        except (OSError, ValueError, IndexError, NotAJournalError) as error:
            msg = "transitions cannot be kept safe from a kill: what was handed over is no journal"
            raise JournalError(msg) from error
        self._ring = ring

    def close(self) -> None:
        """Write no more, and leave the file and what it says to whoever made it."""
        ring, self._ring = self._ring, None
        if ring is not None:
            os.close(self._file)


def boot_id() -> str:
    """Name this run of the machine; empty where it does not say."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""


def _mapped(file: int, header: JournalHeader) -> mmap.mmap:
    """Map the file with every page of it there: no write of a transition may have to ask for one."""
    size = size_of(header.slots)
    os.posix_fallocate(file, 0, size)
    ring = mmap.mmap(file, size)
    for at in range(0, size, mmap.PAGESIZE):
        ring[at] = 0
    packed = header.pack()
    ring[: len(packed)] = packed
    return ring


def _unavailable(error: OSError) -> JournalError:
    return JournalError(f"transitions cannot be kept safe from a kill: {error.strerror}")
