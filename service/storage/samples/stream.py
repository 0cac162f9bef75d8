"""The open end of a session's samples: an Arrow IPC stream that grows by sealed batches.

Arrow writes into memory; what it made goes to the file in one piece at a known place and is synced. A write that fails
is done again at that place, so a file never holds a batch twice, and a kill leaves whole batches and at most one torn.

The memory that Arrow writes a stream to, before it is written to the file.

Seals: a SHA-256 over the bytes of a batch in the file, and over the seal before it.

A batch carries its own seal in its metadata. It is taken with a blank of the same length in the seal's place, so every
byte of the file is under a seal: head, batches, what describes them, and padding.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa

from engine.control import FrameRecord
from engine.core.files import put_in_place, sync_folder
from service.storage.samples.layout import SampleHead, batch_of

FIRST = ""
"""The seal before the first batch."""
BLANK = "-" * 64
SEAL_KEY = "tidegate.sha256"
BEFORE_KEY = "tidegate.sha256_before"


def seal_of(before: str, message: bytes | bytearray | memoryview) -> str:
    """Seal a message that has a blank where its seal belongs."""
    digest = hashlib.sha256(before.encode())
    digest.update(message)
    return digest.hexdigest()


def seal_in_place(written: bytearray, start: int, before: str) -> str:
    """Seal the bytes from ``start`` on, and write the seal into its blank."""
    with memoryview(written) as whole, whole[start:] as message:
        seal = seal_of(before, message)
    place = written.index(BLANK.encode(), start)
    written[place : place + len(BLANK)] = seal.encode()
    return seal


def is_sealed(message: bytes, before: str, seal: str) -> bool:
    """Whether a message from a file carries the seal that its bytes have."""
    blank = message.replace(seal.encode(), BLANK.encode(), 1)
    return len(seal) == len(BLANK) and seal_of(before, blank) == seal


class WrittenBytes:
    """Bytes that Arrow has written and that were not taken yet; pass ``sink`` to Arrow."""

    closed = False

    def __init__(self) -> None:
        self.held = bytearray()
        self.sink = pa.PythonFile(self, mode="w")

    def write(self, piece: bytes) -> int:
        """Append a piece; called by Arrow."""
        self.held += memoryview(piece).cast("B")
        return len(piece)

    def flush(self) -> None:
        """Do nothing; Arrow's side."""

    def close(self) -> None:
        """Do nothing; Arrow's side."""

    def take(self) -> bytes:
        """Return the bytes and clear the memory."""
        taken = bytes(self.held)
        self.held.clear()
        return taken


class SampleStream:
    """One session's stream file, written by one thread; ``seal`` and ``rows`` describe what was appended."""

    def __init__(self, path: Path, head: SampleHead) -> None:
        self.path = path
        self.rows = 0
        self._is_finished = False
        self._schema = head.schema
        self._memory = WrittenBytes()
        options = pa.ipc.IpcWriteOptions(use_threads=False)
        self._writer = pa.ipc.new_stream(self._memory.sink, self._schema, options=options)
        self.seal = FIRST
        self._write(batch_of(self._schema, []), 0)  # a batch of no rows carries the head's seal
        self._end = len(self._memory.held)
        self._file = self._begin()

    def _begin(self) -> int:
        """Put the file there with its head whole: there is no file without one."""
        partial = self.path.with_name(f"{self.path.name}.partial")
        partial.write_bytes(self._memory.held)
        self._memory.held.clear()
        put_in_place(partial, self.path)
        return os.open(self.path, os.O_WRONLY | os.O_CLOEXEC)

    @property
    def is_there(self) -> bool:
        """Whether the file still exists at its path: anything written to a removed file is lost."""
        try:
            found = self.path.stat()
        except OSError:
            return False
        ours = os.fstat(self._file)
        return (found.st_dev, found.st_ino) == (ours.st_dev, ours.st_ino)

    def append(self, records: Sequence[FrameRecord]) -> pa.RecordBatch:
        """Seal a batch; :meth:`sync` brings it to the disk."""
        batch = batch_of(self._schema, records)
        self._write(batch, len(self._memory.held))
        self.rows += batch.num_rows
        return batch

    def sync(self) -> None:
        """Write what was appended to the disk; can be called again after an OSError."""
        if not self._memory.held:
            return
        _write_at(self._file, self._memory.held, self._end)
        os.fsync(self._file)
        self._end += len(self._memory.held)
        self._memory.held.clear()

    def finish(self) -> None:
        """Write the end mark for readers, and close the file."""
        if not self._is_finished:
            self._writer.close()
            self._is_finished = True
        self.sync()
        self.release()

    def release(self) -> None:
        """Let go of the file as it is."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def discard(self) -> None:
        """Take the file away: nothing was ever measured into it."""
        self.release()
        self.path.unlink(missing_ok=True)
        sync_folder(self.path.parent)

    def _write(self, batch: pa.RecordBatch, start: int) -> None:
        self._writer.write_batch(batch, custom_metadata={BEFORE_KEY: self.seal, SEAL_KEY: BLANK})
        self.seal = seal_in_place(self._memory.held, start, self.seal)


def _write_at(file: int, content: bytearray, place: int) -> None:
    view, done = memoryview(content), 0
    try:
        while done < len(view):
            done += os.pwrite(file, view[done:], place + done)
    finally:
        view.release()
