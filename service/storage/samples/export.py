"""A session's samples as CSV or Arrow, written piece by piece: memory use does not grow with the session."""

import csv
import io
import math
from collections.abc import Iterator, Sequence

import pyarrow as pa

from service.storage.samples.memory import WrittenBytes

CSV_COLUMNS = (
    *("frame_index", "timestamp_us", "state", "whole_mm", "thorax_mm", "abdomen_mm", "volume_l", "gate", "hold_reason"),
    *("received_ns", "decided_ns", "asserted_ns", "captured_ns", "phase_percent"),
)
DIGITS = 5  # precision of a single-precision length in mm


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
