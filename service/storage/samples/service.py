"""Export of samples over the API: of a running session as far as they are written, of a closed one all."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO, Literal

import pyarrow as pa

from engine.core.files import PIECE_BYTES
from service.core.errors import SamplesRemovedError, SessionStateError
from service.core.schemas import sessions
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.samples.layout import SampleHead
from service.storage.samples.store import SampleStore
from service.storage.samples.stream import WrittenBytes

CSV_COLUMNS = (
    *("frame_index", "timestamp_us", "state", "whole_mm", "thorax_mm", "abdomen_mm", "volume_l", "gate", "hold_reason"),
    *("received_ns", "decided_ns", "asserted_ns", "captured_ns", "phase_percent"),
)
DIGITS = 5  # precision of a single-precision length in mm
SampleFormat = Literal["csv", "arrow", "parquet"]
MEDIA: dict[SampleFormat, str] = {
    "csv": "text/csv",
    "arrow": "application/vnd.apache.arrow.stream",
    "parquet": "application/vnd.apache.parquet",
}
SUFFIX: dict[SampleFormat, Literal[".csv", ".arrows", ".parquet"]] = {
    "csv": ".csv",
    "arrow": ".arrows",
    "parquet": ".parquet",
}


# A session's samples as CSV or Arrow, written piece by piece: memory use does not grow with the session.
def csv_pieces(batches: Iterator[pa.RecordBatch], named: Sequence[str]) -> Iterator[str]:
    """Write CSV with a column for each named region; a value that could not be measured is empty, never zero."""
    yield ",".join([*CSV_COLUMNS, *(f"{name}_mm" for name in named)]) + "\n"
    for batch in batches:
        text = io.StringIO()
        columns = [batch[name].to_pylist() for name in CSV_COLUMNS]
        regions = (_named(cells, len(named)) for cells in batch["named_mm"].to_pylist())
        rows = zip(*columns, regions, strict=True)
        csv.writer(text, lineterminator="\n").writerows([*plain, *cells] for *plain, cells in rows)
        yield text.getvalue()


def arrow_pieces(batches: Iterator[pa.RecordBatch], schema: pa.Schema) -> Iterator[bytes]:
    """Write an Arrow IPC stream."""
    written = WrittenBytes()
    with pa.ipc.new_stream(written.sink, schema, options=pa.ipc.IpcWriteOptions(use_threads=False)) as writer:
        for batch in batches:
            writer.write_batch(batch.cast(schema))
            yield written.take()
    yield written.take()


def _named(cells: list[float] | None, count: int) -> list[float | None]:
    if cells is None:
        return [None] * count
    return [round(value, DIGITS) if math.isfinite(value) else None for value in cells]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleExport:
    """A session's samples in one format, read from the disk piece by piece as ``pieces`` is consumed."""

    pieces: Iterator[bytes]
    media_type: str
    file_name: str


class SampleService:
    """Exports the samples of sessions."""

    def __init__(self, database: Database, store: SampleStore) -> None:
        self._database = database
        self._store = store

    def export(self, session_id: str, form: SampleFormat) -> SampleExport:
        """Export a session's samples.

        Raises
        ------
        SamplesRemovedError
            They were removed; the audit has the reason.
        SessionStateError
            Parquet was requested before the session is closed.
        """
        with self._database.read() as db:
            row = queries.session_row(db, session_id)
            named = [region.name for region in sessions.Regions.model_validate_json(row.regions).named]
            self.refuse_removed(session_id, row.summary)
        pieces = self._csv(session_id, named) if form == "csv" else self._binary(session_id, form, tuple(named))
        return SampleExport(pieces=pieces, media_type=MEDIA[form], file_name=f"{session_id}{SUFFIX[form]}")

    def _csv(self, session_id: str, named: list[str]) -> Iterator[bytes]:
        batches = self._store.batches(
            session_id
        )  # opened now: an error is then refused as a problem, not as a broken answer
        return (text.encode() for text in csv_pieces(batches, named))

    def _binary(self, session_id: str, form: SampleFormat, named: tuple[str, ...]) -> Iterator[bytes]:
        if form == "arrow":
            head = self._store.head(session_id) or SampleHead(session_id=session_id, regions=named)
            return arrow_pieces(self._store.batches(session_id), head.schema)
        path = self._store.parquet_path(session_id)
        try:
            file = path.open("rb")
        except FileNotFoundError as error:
            msg = "Parquet is made when the session closes: ask for csv or arrow until then"
            raise SessionStateError(msg, field="format", value=form, bound="csv or arrow") from error
        return _read(file)

    def refuse_removed(self, session_id: str, summary: str | None) -> None:
        """Raise SamplesRemovedError where a session had samples and they are gone."""
        if summary is None or self._store.has(session_id):
            return
        if sessions.Summary.model_validate_json(summary).frames:
            msg = "the session's samples have been removed; the audit has the time and the reason"
            raise SamplesRemovedError(msg, field="session_id", value=session_id)


def _read(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while piece := file.read(PIECE_BYTES):
            yield piece
