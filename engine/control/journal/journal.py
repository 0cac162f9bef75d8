"""The transition journal: every transition in memory that outlives this process, so that kill -9 loses none.

A ring of slots in a mapped file, created before the session begins. Writing a slot copies a kilobyte: no system call,
no lock, no wait. A permit is prepared before the line is ordered, then committed or aborted; a hold is committed right
after the line was held, because nothing may delay a hold. The audit acknowledges what it has written to its database;
a ring that is about to overwrite a transition without acknowledgement faults the gate.
"""

import fcntl
import mmap
import os
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from engine.control.journal.format import (
    JournalFormatError,
    JournalHeader,
    file_size,
    pack_aborted,
    pack_slot,
    read_header,
    slot_offset,
)
from engine.control.outputs import GateTransition
from engine.core.clock import Clock
from engine.core.errors import TidegateError

SLOTS = 2048
RESERVED_SLOTS = 64
"""Slots kept free: the fault of a full ring causes transitions of its own."""

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class JournalError(TidegateError):
    """The journal could not be created or opened."""

    code = "journal_unavailable"


class Journal(Protocol):
    """Keeps transitions until the audit has acknowledged them."""

    @property
    def is_behind(self) -> bool:
        """Whether the audit has left too many without acknowledgement."""

    def prepare(self, transition: GateTransition) -> int | None:
        """Write a permit before the line is ordered; return its number."""

    def commit(self, transition: GateTransition, *, prepared: int | None = None) -> int | None:
        """Write a transition that the line has carried out; ``prepared`` is its prepared entry. Return its number."""

    def abort(self, transition: GateTransition, number: int) -> None:
        """Cancel the prepared entry ``number``: it became no transition."""


class NoJournal:
    """Keeps nothing: for runs without an audit."""

    is_behind = False

    def prepare(self, transition: GateTransition) -> int | None:  # noqa: ARG002 - the protocol's
        """Keep nothing."""
        return None

    def commit(self, transition: GateTransition, *, prepared: int | None = None) -> int | None:  # noqa: ARG002 - the protocol's
        """Keep nothing."""
        return None

    def abort(self, transition: GateTransition, number: int) -> None:
        """Keep nothing."""


class OwnerJournal:
    """A journal in the process that created it and writes the audit, while another process (the client) writes it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.acknowledged = 0
        self._newest_committed: int | None = None

    def acknowledge(self, number: int) -> None:
        """Note that the audit has every transition up to ``number``; the client gets it with the next heartbeat."""
        self.acknowledged = max(self.acknowledged, number)

    def client_closed(self, newest_committed: int) -> None:
        """Note, at the client's end, the number of the last transition that it committed."""
        self._newest_committed = newest_committed

    @property
    def is_orphaned(self) -> bool:
        """Whether the client ended without reporting its last number."""
        return self._newest_committed is None

    def close(self) -> None:
        """Remove the file where the audit has all of it; otherwise the next start recovers it."""
        if self._newest_committed is not None and self.acknowledged >= self._newest_committed:
            self.path.unlink(missing_ok=True)


class TransitionJournal:
    """One session's ring; its callers ensure that only one thread writes at a time."""

    def __init__(self, path: Path, *, session_id: str, clock: Clock, slots: int = SLOTS) -> None:
        self.path = path
        self._slots = slots
        self._number = 0
        self._newest_committed = 0
        self._acknowledged = 0
        self._owner: OwnerJournal | None = None
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

    def hand_over(self, send_file: Callable[[int], None]) -> OwnerJournal:
        """Make another process the writer: ``send_file`` sends it the open file, and the file's lock goes with it."""
        ring, self._ring = self._ring, None
        if ring is None:
            msg = "a journal that is closed cannot be handed over"
            raise JournalError(msg)
        ring.close()
        self._owner = OwnerJournal(self.path)
        try:
            send_file(self._file)
        finally:
            os.close(self._file)
        return self._owner

    @property
    def newest_committed(self) -> int:
        """The number of the last transition that was committed."""
        return self._newest_committed

    @property
    def is_behind(self) -> bool:
        """Whether the next writes would come near a transition without acknowledgement."""
        return self._number - self._acknowledged > self._slots - RESERVED_SLOTS

    @property
    def is_acknowledged(self) -> bool:
        """Whether the audit has every transition that was committed."""
        return self._acknowledged >= self._newest_committed

    def prepare(self, transition: GateTransition) -> int | None:
        """Write a permit before the line is ordered; return its number."""
        self._number += 1
        self._put(self._number, pack_slot(self._number, transition, prepared=0, is_committed=False))
        return self._number

    def commit(self, transition: GateTransition, *, prepared: int | None = None) -> int | None:
        """Write a transition that the line has carried out; return its number."""
        self._number += 1
        self._put(self._number, pack_slot(self._number, transition, prepared=prepared or 0, is_committed=True))
        self._newest_committed = self._number
        return self._number

    def abort(self, transition: GateTransition, number: int) -> None:
        """Cancel the prepared entry ``number``."""
        self._number += 1
        self._put(self._number, pack_aborted(self._number, transition, prepared=number))

    def acknowledge(self, number: int) -> None:
        """Release the slots of all entries up to this number: the audit has committed them."""
        self._acknowledged = max(self._acknowledged, number)
        if self._owner is not None:
            self._owner.acknowledge(number)

    @property
    def is_orphaned(self) -> bool:
        """Whether a client wrote it and ended without reporting its last number: only the file has it."""
        return self._owner is not None and self._owner.is_orphaned

    def close(self) -> None:
        """Stop writing; remove the file where the audit has all of it, otherwise the next start recovers it."""
        ring, self._ring = self._ring, None
        if ring is None:
            if self._owner is not None:
                self._owner.close()
            return
        if self.is_acknowledged:
            self.path.unlink(missing_ok=True)
        with suppress(BufferError):
            ring.close()
        os.close(self._file)

    def _put(self, number: int, slot: bytes) -> None:
        ring = self._ring
        if ring is None:
            return
        at = slot_offset(number, self._slots)
        ring[at : at + len(slot)] = slot


class ClientJournal(TransitionJournal):
    """The journal in the client: another process created it, and removes it. Its lock has come with the open file.

    Raises
    ------
    JournalError
        The file is no journal.
    """

    def __init__(self, file: int) -> None:
        self.path, self._file = Path(), file
        self._number = self._newest_committed = self._acknowledged = 0
        self._owner = None
        try:
            ring = mmap.mmap(file, 0)
            self._slots = read_header(ring[:]).slots
            for at in range(0, file_size(self._slots), mmap.PAGESIZE):
                ring[at] = ring[at]  # as where it was made: no write of a transition may have to ask for a page
        except (OSError, ValueError, IndexError, JournalFormatError) as error:
            msg = "transitions cannot be kept safe from a kill: what was handed over is no journal"
            raise JournalError(msg) from error
        self._ring = ring

    def close(self) -> None:
        """Stop writing; the owner removes the file or recovers it."""
        ring, self._ring = self._ring, None
        if ring is not None:
            os.close(self._file)


def boot_id() -> str:
    """Return the machine's boot ID; empty where the system has none."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""


def _mapped(file: int, header: JournalHeader) -> mmap.mmap:
    """Map the file with every page of it there: no write of a transition may have to ask for one."""
    size = file_size(header.slots)
    os.posix_fallocate(file, 0, size)
    ring = mmap.mmap(file, size)
    for at in range(0, size, mmap.PAGESIZE):
        ring[at] = 0
    packed = header.pack()
    ring[: len(packed)] = packed
    return ring


def _unavailable(error: OSError) -> JournalError:
    return JournalError(f"transitions cannot be kept safe from a kill: {error.strerror}")
