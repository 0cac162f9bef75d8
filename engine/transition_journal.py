"""Every transition in memory that outlives this process, before or as it happens: kill -9 loses none.

A ring of slots in a mapped file, made and touched before the session begins. Writing one copies a kilobyte: no call to
the system, no lock, no wait. A permit is written before the line hears of it; a hold right after, for nothing may stand
in a hold's way. The audit confirms what it has committed; a ring about to overwrite what it has not is trouble.
"""

import fcntl
import mmap
import os
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from engine.clock import Clock
from engine.errors import TidegateError
from engine.journal_slots import JournalHeader, pack_slot, pack_void, place_of, size_of
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


class TransitionJournal:
    """One session's ring; its callers see to it that only one of them writes at a time."""

    def __init__(self, path: Path, *, session_id: str, clock: Clock, slots: int = SLOTS) -> None:
        self.path = path
        self._slots = slots
        self._number = 0
        self._newest_told = 0
        self._confirmed = 0
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

    def close(self) -> None:
        """Write no more; the file is removed when the audit has all of it, else the next start reads it."""
        ring, self._ring = self._ring, None
        if ring is None:
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
