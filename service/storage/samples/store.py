"""The folder of sample files: `<session>.arrows` while a session is open, `<session>.parquet` once it is closed.

While the stream exists it is authoritative, and a Parquet file beside it has not been used yet. So every step of
closing a session can be repeated: settle, record the session's end, only then remove the stream.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from engine.core.files import put_in_place, remove, sync_folder
from service.storage.samples.layout import SampleHead
from service.storage.samples.parquet import (
    NotReadBackError,
    Stored,
    parquet_head,
    read_parquet,
    read_row,
    write_parquet,
)
from service.storage.samples.stream import SampleStream
from service.storage.samples.walk import Ending, NoSamplesError, StreamWalk

STREAM, PARQUET, PARTIAL, ASIDE = ".arrows", ".parquet", ".partial", ".damaged"


@dataclass(frozen=True, slots=True, kw_only=True)
class Settlement:
    """The result of settling a stream: the Parquet file made of it, and whether data were lost.

    Attributes
    ----------
    stored
        The Parquet file; None where the head of the stream could not be read.
    stream_sha256
        Seal of the last complete batch.
    lost_bytes
        Bytes that could not be read and are not in the Parquet file.
    kept_aside
        Name of the file with all bytes of a damaged stream; None for a stream torn by a kill, whose tail has no data.
    """

    stored: Stored | None
    stream_sha256: str
    ending: Ending
    detail: str = ""
    lost_bytes: int = 0
    kept_aside: str | None = None

    @property
    def is_whole(self) -> bool:
        """Whether nothing was lost: a stream that was cut off between two batches is whole too."""
        return self.lost_bytes == 0 and self.stored is not None

    @property
    def audit_detail(self) -> dict[str, object]:
        """What the audit records of it."""
        stored = self.stored
        return {
            "rows": 0 if stored is None else stored.rows,
            "bytes": 0 if stored is None else stored.size,
            "parquet_sha256": None if stored is None else stored.sha256,
            "stream_sha256": self.stream_sha256,
            "ending": self.ending.value,
            "detail": self.detail,
            "lost_bytes": self.lost_bytes,
            "kept_aside": self.kept_aside,
        }


class SampleStore:
    """A folder of sample files."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def begin(self, head: SampleHead) -> SampleStream:
        """Open a session's stream, its head on the disk."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return SampleStream(self.stream_path(head.session_id), head)

    def batches(self, session_id: str, columns: Sequence[str] | None = None) -> Iterator[pa.RecordBatch]:
        """Read a session's samples, or some of their columns, as far as they are written; nothing without a file."""
        for read in (self._read_stream, self._read_parquet):  # a stream is removed only after its Parquet file exists
            try:
                return read(session_id, columns)
            except FileNotFoundError:
                continue
        return iter(())

    def row(self, session_id: str, index: int) -> pa.RecordBatch:
        """Read the sample with this number, from 0; raise FileNotFoundError where there is none."""
        if self.stream_path(session_id).exists():
            for batch in self._read_stream(session_id, None):
                if index < batch.num_rows:
                    return batch.slice(index, 1)
                index -= batch.num_rows
            raise FileNotFoundError(self.stream_path(session_id))
        with _readable(session_id):
            return read_row(self.parquet_path(session_id), index)

    def has(self, session_id: str) -> bool:
        """Whether there is a file of this session."""
        return self.stream_path(session_id).exists() or self.parquet_path(session_id).exists()

    def settle(self, session_id: str, watch: Callable[[pa.RecordBatch], None] = lambda _batch: None) -> Settlement:
        """Make the Parquet file of a stream, calling ``watch`` with every batch; the stream stays.

        Raises
        ------
        OSError
            It could not be written; the stream is as it was.
        """
        path = self.stream_path(session_id)
        try:
            with StreamWalk(path) as walk:
                stored = write_parquet(self.parquet_path(session_id), walk.schema, _shown(walk, watch))
                if stored.rows != walk.rows:
                    msg = f"{path.name} has {walk.rows} rows, and {stored.rows} were written"
                    raise NotReadBackError(msg)
                lost_bytes = walk.size - walk.end if walk.ending in {Ending.TORN, Ending.DAMAGED} else 0
                aside = self._keep_aside(path) if walk.ending is Ending.DAMAGED else None
                return Settlement(
                    stored=stored,
                    stream_sha256=walk.seal,
                    ending=walk.ending,
                    detail=walk.detail,
                    lost_bytes=lost_bytes,
                    kept_aside=aside,
                )
        except NoSamplesError as error:
            size, aside = path.stat().st_size, self._keep_aside(path)
            return Settlement(
                stored=None,
                stream_sha256="",
                ending=Ending.DAMAGED,
                detail=str(error),
                lost_bytes=size,
                kept_aside=aside,
            )

    def forget_stream(self, session_id: str) -> None:
        """Remove the stream, once the audit has its Parquet file."""
        remove(self.stream_path(session_id))

    def left_streams(self) -> list[str]:
        """Sessions whose stream is still there."""
        return self._named(STREAM)

    def stored(self) -> list[str]:
        """Sessions that have a Parquet file."""
        return self._named(PARQUET)

    def sweep(self) -> None:
        """Remove files that were never completed."""
        for path in self.folder.glob(f"*{PARTIAL}"):
            path.unlink(missing_ok=True)

    def stream_path(self, session_id: str) -> Path:
        """Return the path of a session's stream."""
        return self.folder / f"{session_id}{STREAM}"

    def parquet_path(self, session_id: str) -> Path:
        """Return the path of a closed session's Parquet file."""
        return self.folder / f"{session_id}{PARQUET}"

    def head(self, session_id: str) -> SampleHead | None:
        """Read the head of a session's file; None without a file."""
        try:
            with StreamWalk(self.stream_path(session_id)) as walk:
                return walk.head
        except FileNotFoundError:
            pass
        try:
            return parquet_head(self.parquet_path(session_id))[0]
        except FileNotFoundError:
            return None

    def _named(self, suffix: str) -> list[str]:
        return sorted(path.stem for path in self.folder.glob(f"*{suffix}") if "." not in path.stem)

    def _read_parquet(self, session_id: str, columns: Sequence[str] | None) -> Iterator[pa.RecordBatch]:
        with _readable(session_id):
            return read_parquet(self.parquet_path(session_id), columns)

    def _read_stream(self, session_id: str, columns: Sequence[str] | None) -> Iterator[pa.RecordBatch]:
        return _pieces(StreamWalk(self.stream_path(session_id)), columns)

    def _keep_aside(self, path: Path) -> str:
        """Preserve the damaged file under a second name: as a hard link, or a copy where links are not supported."""
        aside = path.with_name(f"{path.stem}{ASIDE}{STREAM}")
        if not aside.exists():
            try:
                os.link(path, aside)
                sync_folder(path.parent)
            except OSError:
                partial = aside.with_name(f"{aside.name}{PARTIAL}")
                shutil.copyfile(path, partial)
                put_in_place(partial, aside)
        return aside.name


def _pieces(walk: StreamWalk, columns: Sequence[str] | None) -> Iterator[pa.RecordBatch]:
    with walk:
        yield from walk if columns is None else (batch.select(list(columns)) for batch in walk)


@contextmanager
def _readable(session_id: str) -> Iterator[None]:
    """Raise NoSamplesError where the file that is read is damaged."""
    try:
        yield
    except pa.ArrowException as error:
        msg = f"the sample file of session {session_id} cannot be read"
        raise NoSamplesError(msg) from error


def _shown(batches: StreamWalk, watch: Callable[[pa.RecordBatch], None]) -> Iterator[pa.RecordBatch]:
    for batch in batches:
        watch(batch)
        yield batch
