"""The newest end of a session's samples, for a client of the live stream that was away: rows after a frame, in pages.

A stream is followed as it grows: where its batches lie is found once and remembered, so that the end of a long session
is read without the rest. Seals are not checked here; export and ``verify`` check them.
"""

from __future__ import annotations

import threading
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from service.storage.samples.layout import SampleHead, head_of
from service.storage.samples.store import SampleStore

COLUMNS = (
    *("frame_index", "timestamp_us", "state", "gate", "hold_reason", "line_on"),
    *("signal_mm", "whole_mm", "thorax_mm", "abdomen_mm", "volume_l", "captured_ns", "received_ns", "asserted_ns"),
)
SESSIONS_FOLLOWED = 4
GROUPS = 4
"""Row groups of five minutes: with the last one, which is not full, more than is ever sent again."""
Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """Rows in order; fewer than requested only at the end of the file."""

    rows: list[Row]
    head: SampleHead


@dataclass(frozen=True, slots=True)
class _Place:
    offset: int
    last_frame: int
    last_ns: int


class NothingRecordedError(Exception):
    """There is no file of this session, or none that can be read."""


class SampleTails:
    """Reads the ends of sessions' sample files; for any thread."""

    def __init__(self, store: SampleStore) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._followed: dict[str, _StreamTail] = {}
        self._kept: tuple[str, pa.Table] | None = None

    def newest_ns(self, session_id: str) -> int:
        """Return when the newest frame that is written was received; raise NothingRecordedError without one."""
        try:
            return self._tail(session_id).newest_ns()
        except (FileNotFoundError, IndexError):
            pass
        last = self._closed(session_id).column("received_ns")
        if len(last) == 0:
            raise NothingRecordedError
        return int(last[-1].as_py())

    def page(self, session_id: str, after: int, *, oldest_ns: int, most: int) -> Page:
        """Return rows after a frame that were received at or after ``oldest_ns``."""
        try:
            return self._tail(session_id).page(after, oldest_ns, most)
        except FileNotFoundError:
            return self._closed_page(session_id, after, oldest_ns, most)

    def _tail(self, session_id: str) -> _StreamTail:
        path = self._store.stream_path(session_id)
        if not path.exists():
            raise FileNotFoundError
        with self._lock:
            if session_id not in self._followed:
                if len(self._followed) >= SESSIONS_FOLLOWED:
                    self._followed.pop(next(iter(self._followed)))
                self._followed[session_id] = _StreamTail(path)
            return self._followed[session_id]

    def _closed(self, session_id: str) -> pa.Table:
        """Read the end of a closed session; the last one read is cached for the next pages."""
        with self._lock:
            kept = self._kept
        if kept is None or kept[0] != session_id:
            kept = (session_id, _read_end(self._store.parquet_path(session_id)))
            with self._lock:
                self._kept = kept
        return kept[1]

    def _closed_page(self, session_id: str, after: int, oldest_ns: int, most: int) -> Page:
        table = self._closed(session_id)
        is_wanted = pc.and_(pc.greater(table["frame_index"], after), pc.greater_equal(table["received_ns"], oldest_ns))
        return Page(rows=table.filter(is_wanted).slice(0, most).to_pylist(), head=_head(table.schema))


class _StreamTail:
    """One stream, as far as it is written."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._end = 0
        self._places: list[_Place] = []
        self._schema: pa.Schema | None = None

    def newest_ns(self) -> int:
        with self._lock, pa.OSFile(str(self._path)) as file:
            self._follow(file)
            return self._places[-1].last_ns

    def page(self, after: int, oldest_ns: int, most: int) -> Page:
        with self._lock, pa.OSFile(str(self._path)) as file:
            self._follow(file)
            if self._schema is None:
                raise NothingRecordedError
            first = max(
                bisect_right(self._places, after, key=lambda place: place.last_frame),
                bisect_right(self._places, oldest_ns - 1, key=lambda place: place.last_ns),
            )
            rows: list[Row] = []
            for place in self._places[first:]:
                if len(rows) >= most:
                    break
                file.seek(place.offset)
                batch = pa.ipc.read_record_batch(pa.ipc.read_message(file), self._schema)
                rows += (
                    row
                    for row in batch.select(list(COLUMNS)).to_pylist()
                    if row["frame_index"] > after and row["received_ns"] >= oldest_ns
                )
            return Page(rows=rows[:most], head=_head(self._schema))

    def _follow(self, file: Any) -> None:  # noqa: ANN401 - pyarrow has no types
        """Find the batches appended since; an incomplete one is read the next time."""
        size = file.size()
        while self._end < size:
            file.seek(self._end)
            try:
                message = pa.ipc.read_message(file)
                if message.type == "schema":
                    self._schema = pa.ipc.read_schema(message)
                else:
                    self._remember(pa.ipc.read_record_batch(message, self._schema))
            except (EOFError, OSError, ValueError, pa.ArrowException):
                return
            self._end = int(file.tell())

    def _remember(self, batch: pa.RecordBatch) -> None:
        if batch.num_rows:
            last_frame, last_ns = batch["frame_index"][-1].as_py(), batch["received_ns"][-1].as_py()
            self._places.append(_Place(self._end, last_frame, last_ns))


def _read_end(path: Path) -> pa.Table:
    try:
        with pq.ParquetFile(path, pre_buffer=False) as file:
            count = file.num_row_groups
            wanted = list(range(max(count - GROUPS, 0), count))
            return file.read_row_groups(wanted, columns=list(COLUMNS), use_threads=False)
    except (OSError, pa.ArrowException) as error:
        raise NothingRecordedError from error


def _head(schema: pa.Schema) -> SampleHead:
    try:
        return head_of(schema.metadata or {})
    except (ValueError, KeyError) as error:
        raise NothingRecordedError from error
