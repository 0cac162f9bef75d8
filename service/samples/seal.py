"""Seals: a SHA-256 over what a batch of samples says and over the seal before it.

Taken of the values, not of the bytes that Arrow makes of them: a later Arrow may lay them out otherwise.
"""

import hashlib
from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc


def head_seal(schema: pa.Schema) -> str:
    """Seal a file's head: the first link."""
    digest = hashlib.sha256()
    for key, value in sorted((schema.metadata or {}).items()):
        _add(digest, key)
        _add(digest, value)
    return digest.hexdigest()


def next_seal(previous: str, batch: pa.RecordBatch) -> str:
    """Seal a batch behind the one before."""
    digest = hashlib.sha256(previous.encode())
    digest.update(batch.num_rows.to_bytes(8, "little"))
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        _add(digest, name.encode())
        for piece in _content(column):
            _add(digest, piece)
    return digest.hexdigest()


def _add(digest: "hashlib._Hash", piece: bytes) -> None:
    digest.update(len(piece).to_bytes(8, "little"))  # so that no two contents run together into the same bytes
    digest.update(piece)


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
