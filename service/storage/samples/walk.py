"""A stream read batch by batch, each seal checked; then how it ended: closed, open, torn, or damaged.

A kill leaves a file that is cut off somewhere: torn. Anything else (a batch that is all there and does not fit its
seal, whole batches behind one that cannot be read) is no kill's work: damaged.
"""

from __future__ import annotations

import enum
import mmap
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import pyarrow as pa

from engine.core.errors import TidegateError
from service.storage.samples.layout import SampleHead, head_of
from service.storage.samples.stream import BEFORE_KEY, FIRST, SEAL_KEY, is_sealed

END_MARK = b"\xff\xff\xff\xff\x00\x00\x00\x00"
ENOUGH_SEALS = 2


class Ending(enum.StrEnum):
    """How a stream ends."""

    CLOSED = "closed"
    OPEN = "open"
    TORN = "torn"
    DAMAGED = "damaged"


class NoSamplesError(TidegateError):
    """The file is no sample file, or has no whole head."""

    code = "samples_unreadable"


class StreamWalk:
    """To be iterated over once; ``ending``, ``rows``, ``seal`` and ``end``, the place behind the last batch, follow."""

    def __init__(self, path: Path) -> None:
        self._raw = path.open("rb")  # for bytes that Arrow does not read; raises FileNotFoundError
        self._file = pa.OSFile(str(path))
        try:
            self._reader = pa.ipc.open_stream(self._file, options=pa.ipc.IpcReadOptions(use_threads=False))
            self.head: SampleHead = head_of(self._reader.schema.metadata or {})
        except (pa.ArrowException, OSError, ValueError, TypeError, KeyError) as error:
            self._close()
            msg = f"{path.name} is no sample file"
            raise NoSamplesError(msg) from error
        self.schema = self._reader.schema
        self.seal = FIRST
        self.rows = 0
        self.end = 0
        self.ending = Ending.OPEN
        self.detail = ""

    def __enter__(self) -> Self:
        """Read it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Let go of the file."""
        self._close()

    @property
    def size(self) -> int:
        """How long the file is; one that is written to grows."""
        return os.fstat(self._raw.fileno()).st_size

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        """Yield the complete batches that have rows."""
        while True:
            try:
                batch, said = self._reader.read_next_batch_with_custom_metadata()
            except StopIteration:
                self._judge_end()
                return
            except (pa.ArrowException, OSError) as error:
                self._judge_rest(str(error))
                return
            end = int(self._file.tell())
            if not self._follows(said, end) or not _is_valid(batch):
                self._damaged(f"the batch behind row {self.rows} does not fit its seal")
                return
            self.end = end
            self.rows += batch.num_rows
            if batch.num_rows:
                yield batch

    def _follows(self, said: object, end: int) -> bool:
        """Whether the bytes just read, up to ``end``, match their seal."""
        if not isinstance(said, pa.KeyValueMetadata) or SEAL_KEY not in said:
            return False
        seal = said[SEAL_KEY].decode(errors="replace")
        if not is_sealed(os.pread(self._raw.fileno(), end - self.end, self.end), self.seal, seal):
            return False
        self.seal = seal
        return True

    def _judge_end(self) -> None:
        """Handle the end of what Arrow recognises as the stream."""
        rest = self._rest(len(END_MARK) + 1)
        if rest == END_MARK:
            self.ending = Ending.CLOSED
        elif rest:
            self._judge_rest("what follows is no batch")

    def _judge_rest(self, detail: str) -> None:
        """Handle bytes that Arrow cannot read."""
        if self.size <= self.end:
            return
        if self._seals_behind() > 1:
            self._damaged(f"behind row {self.rows} a batch cannot be read, and others follow it ({detail})")
        else:
            self.ending, self.detail = Ending.TORN, f"cut off behind row {self.rows} ({detail})"

    def _damaged(self, detail: str) -> None:
        self.ending, self.detail = Ending.DAMAGED, detail

    def _seals_behind(self) -> int:
        """Count the batches after the last complete one, by the name of their seal."""
        found = 0
        with mmap.mmap(self._raw.fileno(), 0, access=mmap.ACCESS_READ) as content:
            place = content.find(BEFORE_KEY.encode(), self.end)
            while place >= 0 and found < ENOUGH_SEALS:
                found += 1
                place = content.find(BEFORE_KEY.encode(), place + 1)
        return found

    def _rest(self, most: int) -> bytes:
        self._raw.seek(self.end)
        return self._raw.read(most)

    def _close(self) -> None:
        self._file.close()
        self._raw.close()


def _is_valid(batch: pa.RecordBatch) -> bool:
    try:
        batch.validate()
    except pa.ArrowException:
        return False
    return True
