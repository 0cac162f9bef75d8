"""A digest of the values of rows, independent of the file format: compares Parquet read back with what was written."""

import hashlib
from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc


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
