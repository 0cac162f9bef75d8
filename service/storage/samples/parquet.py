"""A closed session's samples as Parquet: written complete or not at all, and read back before it is used."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from engine.core.files import file_sha256, put_in_place
from service.storage.samples.layout import SampleHead, head_of

ROWS_A_GROUP = 9000
"""Rows per group, five minutes at 30 frames/s: a reader needs some megabytes at a time."""
READ_ROWS = 1000


# A digest of the values of rows, independent of the file format: compares Parquet read back with what was written.
def digest_of(batch: pa.RecordBatch) -> str:
    """Digest the values of all columns; the same for the same rows, however Arrow lays them out."""
    digest = hashlib.sha256(batch.num_rows.to_bytes(8, "little"))
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        for piece in (name.encode(), *_content(column)):
            digest.update(len(piece).to_bytes(8, "little"))  # so that no two contents run together into the same bytes
            digest.update(piece)
    return digest.hexdigest()


def _content(column: pa.Array) -> Iterator[bytes]:
    yield _plain(column.is_valid(), np.uint8)
    kind = column.type
    if pa.types.is_list(kind):
        yield _plain(pc.fill_null(pc.list_value_length(column), 0), "<i8")
        yield _plain(column.flatten(), "<f4")
    elif pa.types.is_string(kind):
        yield "\0".join(text or "" for text in column.to_pylist()).encode()
    elif pa.types.is_boolean(kind):
        yield _plain(column.cast(pa.uint8()).fill_null(0), np.uint8)
    else:
        yield _plain(column.fill_null(0), "<f8" if pa.types.is_floating(kind) else "<i8")


def _plain(column: pa.Array, dtype: type | str) -> bytes:
    return bytes(column.to_numpy(zero_copy_only=False).astype(dtype).tobytes())


@dataclass(frozen=True, slots=True, kw_only=True)
class Stored:
    """A Parquet file that was read back: its rows, size and SHA-256."""

    rows: int
    size: int
    sha256: str


class NotReadBackError(OSError):
    """The file read back differs from the batches written."""


def write_parquet(path: Path, schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> Stored:
    """Write batches to a file beside ``path``, read it back, and give it its name.

    Raises
    ------
    OSError
        It could not be written, or is not what was written; nothing stays behind.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        digests, rows = _write(partial, schema, batches)
        if list(_group_digests(partial)) != digests:
            msg = f"{path.name} was not read back as it was written"
            raise NotReadBackError(msg)
        stored = Stored(rows=rows, size=partial.stat().st_size, sha256=file_sha256(partial))
        put_in_place(partial, path)
    except pa.ArrowException as error:
        msg = f"{path.name} could not be written: {error}"
        raise OSError(msg) from error
    finally:
        partial.unlink(missing_ok=True)
    return stored


def read_parquet(path: Path, columns: Sequence[str] | None = None) -> Iterator[pa.RecordBatch]:
    """Read it a piece at a time; the file is opened at once, and stays readable when it is taken away meanwhile."""
    file = pq.ParquetFile(pa.OSFile(str(path)), pre_buffer=False)
    return _pieces(file, columns)


def read_row(path: Path, index: int) -> pa.RecordBatch:
    """Read one row, from its row group alone."""
    with pq.ParquetFile(pa.OSFile(str(path)), pre_buffer=False) as file:
        group = file.read_row_group(index // ROWS_A_GROUP, use_threads=False)
        return group.slice(index % ROWS_A_GROUP, 1).combine_chunks().to_batches()[0]


def parquet_head(path: Path) -> tuple[SampleHead, int]:
    """Read a file's head, and how many rows it has."""
    with pq.ParquetFile(path, pre_buffer=False) as file:
        return head_of(file.schema_arrow.metadata or {}), int(file.metadata.num_rows)


def _pieces(
    file: pq.ParquetFile,
    columns: Sequence[str] | None,
) -> Iterator[pa.RecordBatch]:
    with file:
        yield from file.iter_batches(batch_size=READ_ROWS, columns=columns, use_threads=False)


def _write(partial: Path, schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> tuple[list[str], int]:
    digests, rows = [], 0
    with pq.ParquetWriter(partial, schema, compression="zstd", use_dictionary=_texts(schema)) as writer:
        for group in _groups(schema, batches):
            writer.write_batch(group, row_group_size=ROWS_A_GROUP)
            digests.append(digest_of(group))
            rows += group.num_rows
    return digests, rows


def _texts(schema: pa.Schema) -> list[str]:
    return [field.name for field in schema if pa.types.is_string(field.type)]


def _groups(schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    held: list[pa.RecordBatch] = []
    rows = 0
    for batch in batches:
        held.append(batch)
        rows += batch.num_rows
        while rows >= ROWS_A_GROUP:
            whole = _joined(schema, held)
            yield whole.slice(0, ROWS_A_GROUP)
            held = [whole.slice(ROWS_A_GROUP)]
            rows -= ROWS_A_GROUP
    if rows:
        yield _joined(schema, held)


def _joined(schema: pa.Schema, held: list[pa.RecordBatch]) -> pa.RecordBatch:
    same = [one if one.schema.equals(schema) else one.cast(schema) for one in held]
    table = pa.Table.from_batches(same, schema).combine_chunks()
    return table.to_batches()[0]


def _group_digests(path: Path) -> Iterator[str]:
    with pq.ParquetFile(path, pre_buffer=False) as file:
        for group in range(file.metadata.num_row_groups):
            table = file.read_row_group(group, use_threads=False).combine_chunks()
            yield digest_of(table.to_batches()[0])
