"""Samples that lay in the database until revision 0008: out of their table into files, and back; flat in memory."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from sqlalchemy import Connection, text

from service.storage.samples.layout import SampleHead
from service.storage.samples.parquet import parquet_head, write_parquet
from service.storage.samples.store import SampleStore

ROWS_A_PIECE = 1000
PLAIN = (
    *("frame_index", "timestamp_us", "missed_frames", "state", "lost_reason", "whole_mm", "thorax_mm", "abdomen_mm"),
    *("volume_l", "signal_mm", "residual_mm", "valid_share", "gate", "hold_reason", "line_on", "received_ns"),
    *("decided_ns", "asserted_ns", "region_rows", "captured_ns", "phase_percent"),
)
LISTS = ("regions_mm", "named_mm")
STORED_DTYPE = "<f4"

SESSIONS = text(
    "SELECT s.id, s.regions, s.model_id, c.sha256 FROM sessions s JOIN calibrations c ON c.id = s.calibration_id "
    "WHERE EXISTS (SELECT 1 FROM samples WHERE session_id = s.id) ORDER BY s.id"
)
PIECE = text(
    f"SELECT {', '.join((*PLAIN, *LISTS))} FROM samples "  # noqa: S608 - names of this file alone # nosec B608
    "WHERE session_id = :session_id AND frame_index > :after ORDER BY frame_index LIMIT :most"
)
INSERT = text(
    f"INSERT INTO samples (session_id, {', '.join((*PLAIN, *LISTS))}) "  # noqa: S608 - likewise # nosec B608
    f"VALUES (:session_id, {', '.join(f':{name}' for name in (*PLAIN, *LISTS))})"
)


def move_out(connection: Connection, folder: Path | None) -> None:
    """Write every session's samples to a Parquet file, and read it back before the table is dropped.

    An existing file with as many rows is of an earlier downgrade: it has more columns and stays.
    """
    sessions = connection.execute(SESSIONS).all()
    if not sessions:
        return
    store = _store(folder)
    store.folder.mkdir(parents=True, exist_ok=True)
    for session_id, regions, model_id, calibration_sha256 in sessions:
        count = text("SELECT count(*) FROM samples WHERE session_id = :session_id")
        rows = connection.execute(count, {"session_id": session_id}).scalar_one()
        path = store.parquet_path(session_id)
        if path.exists() and parquet_head(path)[1] == rows:
            continue
        head = SampleHead(
            session_id=session_id,
            calibration_sha256=calibration_sha256,
            model_id=model_id or "",
            regions=_names(regions),
        )
        write_parquet(path, head.schema, _pieces(connection, session_id, head.schema))


def move_back(connection: Connection, folder: Path | None) -> None:
    """Put every session's samples back into the table; the files stay, since the table cannot hold all they say."""
    if folder is None or not folder.is_dir():
        return
    store = _store(folder)
    known = set(connection.execute(text("SELECT id FROM sessions")).scalars())
    for session_id in sorted({*store.stored(), *store.left_streams()} & known):
        for batch in store.batches(session_id):
            connection.execute(INSERT, [_row(session_id, row) for row in batch.to_pylist()])


def _names(regions: str) -> tuple[str, ...]:
    """Return the named regions of a session; none where its row has no such field."""
    try:
        return tuple(region["name"] for region in json.loads(regions).get("named", []))
    except (ValueError, KeyError, TypeError, AttributeError):
        return ()


def _store(folder: Path | None) -> SampleStore:
    if folder is None:
        msg = "the database has samples, and no folder for them was given"
        raise ValueError(msg)
    return SampleStore(folder)


def _pieces(connection: Connection, session_id: str, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    after = -1
    while True:
        values = {"session_id": session_id, "after": after, "most": ROWS_A_PIECE}
        rows = connection.execute(PIECE, values).mappings().all()
        if not rows:
            return
        after = rows[-1]["frame_index"]
        read = [{**row, **{name: _cells(row[name]) for name in LISTS}, "line_on": bool(row["line_on"])} for row in rows]
        columns = [pa.array([row.get(field.name) for row in read], field.type) for field in schema]
        yield pa.RecordBatch.from_arrays(columns, schema=schema)


def _cells(stored: bytes | None) -> Any:  # noqa: ANN401 - an array, as pyarrow takes it
    return None if stored is None else np.frombuffer(bytes(stored), dtype=STORED_DTYPE)


def _row(session_id: str, read: dict[str, Any]) -> dict[str, Any]:
    lists = {
        name: None if read[name] is None else np.asarray(read[name], dtype=STORED_DTYPE).tobytes() for name in LISTS
    }
    return {"session_id": session_id, **{name: read[name] for name in PLAIN}, **lists}
