"""Check a session's sample file against the hash in the audit.

Sample files in the audit: each file's hash, and which files were removed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import pyarrow as pa
from sqlalchemy import select
from sqlalchemy.orm import Session

from engine.core.files import file_sha256
from service.storage.audit import AuditRow
from service.storage.samples.parquet import parquet_head
from service.storage.samples.store import SampleStore
from service.storage.samples.walk import Ending, NoSamplesError, StreamWalk

CLOSED, SETTLED, REMOVED = "session.close", "samples.settled", "samples.removed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Registered:
    """A session's newest sample entry in the audit: rows, hash of the Parquet file, whether it was removed."""

    rows: int = 0
    sha256: str | None = None
    is_removed: bool = False


def registered(db: Session, session_id: str) -> Registered:
    """Read a session's newest sample entry; None without one."""
    query = select(AuditRow.action, AuditRow.detail).where(
        AuditRow.session_id == session_id, AuditRow.action.in_((CLOSED, SETTLED, REMOVED))
    )
    found = Registered()
    for action, text in db.execute(query.order_by(AuditRow.sequence)):
        detail = json.loads(text)
        said = detail.get("samples", {}) if action == CLOSED else detail
        if action == REMOVED:
            found = Registered(rows=found.rows, sha256=found.sha256, is_removed=True)
        elif said.get("parquet_sha256") is not None:
            found = Registered(rows=int(said["rows"]), sha256=str(said["parquet_sha256"]))
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """The result for one session; ``form`` is parquet, stream, removed or none."""

    session_id: str
    form: str
    rows: int
    size: int
    is_good: bool
    detail: str


def check(store: SampleStore, session_id: str, known: Registered, *, is_open: bool) -> Finding:
    """Read a session's file through and hold it against the audit.

    Parameters
    ----------
    is_open
        Whether the session runs: its stream may end in the middle of a batch that is being written.
    """
    stream, parquet = store.stream_path(session_id), store.parquet_path(session_id)
    try:
        if stream.exists():
            return _check_stream(store, session_id, is_open=is_open)
        if parquet.exists():
            return _check_parquet(store, session_id, known)
    except (NoSamplesError, pa.ArrowException, OSError) as error:
        return _found(session_id, "none", 0, 0, f"cannot be read: {error}", is_good=False)
    if known.is_removed:
        return _found(session_id, "removed", known.rows, 0, "removed, as recorded in the audit", is_good=True)
    if known.sha256 is not None:
        return _found(session_id, "none", known.rows, 0, "the file recorded in the audit is missing", is_good=False)
    return _found(session_id, "none", 0, 0, "nothing was measured", is_good=True)


def _check_stream(store: SampleStore, session_id: str, *, is_open: bool) -> Finding:
    path = store.stream_path(session_id)
    with StreamWalk(path) as walk:
        for _ in walk:
            pass
        size = walk.size
    is_good = walk.ending in {Ending.CLOSED, Ending.OPEN} or (is_open and walk.ending is Ending.TORN)
    detail = walk.detail if not is_good else f"every batch fits its seal ({'open' if is_open else 'not settled yet'})"
    return _found(session_id, "stream", walk.rows, size, detail, is_good=is_good)


def _check_parquet(store: SampleStore, session_id: str, known: Registered) -> Finding:
    path = store.parquet_path(session_id)
    size, sha256 = path.stat().st_size, file_sha256(path)
    if known.sha256 is None:
        return _found(session_id, "parquet", 0, size, "the audit has no record of this file", is_good=False)
    if sha256 != known.sha256:
        return _found(session_id, "parquet", 0, size, "was changed: its SHA-256 is not the audit's", is_good=False)
    return _found(session_id, "parquet", parquet_head(path)[1], size, "as recorded in the audit", is_good=True)


def _found(session_id: str, form: str, rows: int, size: int, detail: str, *, is_good: bool) -> Finding:
    return Finding(session_id=session_id, form=form, rows=rows, size=size, is_good=is_good, detail=detail)
