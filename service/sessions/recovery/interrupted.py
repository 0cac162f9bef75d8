"""Recovery at the start: close sessions that a killed process left open, and make Parquet files of their streams.

Every step can be done again: a start that is killed in the middle leaves it to the next one.
"""

from __future__ import annotations

import logging
from datetime import UTC, datetime

import pyarrow as pa

from service.sessions.records.audit_events import closing_event
from service.storage import audit
from service.storage.audit import SYSTEM, Event
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.samples.figures import Figures
from service.storage.samples.store import SampleStore, Settlement
from service.storage.samples.walk import NoSamplesError

logger = logging.getLogger(__name__)

INTERRUPTED = "the service ended while this session ran"


def close_interrupted(database: Database, store: SampleStore) -> None:
    """Close sessions that a killed process left running, and settle their streams; called once at the start."""
    store.sweep()
    with database.read() as db:
        running = [row.id for row in queries.running_sessions(db)]
    for session_id in running:
        _close(database, store, session_id)
    for session_id in store.left_streams():
        _settle_late(database, store, session_id)


def _close(database: Database, store: SampleStore, session_id: str) -> None:
    """Record a session's end, with the figures of its samples."""
    figures = Figures()
    settled = _settled(store, session_id, figures) if session_id in store.left_streams() else None
    said = {} if settled is None else settled.audit_detail
    if settled is None:
        figures, said = _counted(store, session_id)
    with database.write() as db:
        row = queries.session_row(db, session_id)
        row.status, row.status_detail, row.ended_at = "interrupted", INTERRUPTED, datetime.now(UTC)
        figures.transitions = queries.transition_count(db, session_id)
        figures.holds = queries.hold_counts(db, session_id)
        summary = figures.summary()
        row.summary = summary.model_dump_json()
        if settled is not None and not settled.is_whole:
            audit.append(db, _repaired(session_id, settled))
        audit.append(db, closing_event(row, summary, said, actor=SYSTEM))
    _forget(store, session_id, settled)


def _counted(store: SampleStore, session_id: str) -> tuple[Figures, dict[str, object]]:
    """Count the readable samples where nothing was settled; a session with an unreadable file is closed, too."""
    figures = Figures()
    try:
        for batch in store.batches(session_id):
            figures.add(batch)
    except _unreadable() as error:
        logger.error("the samples of session %s cannot be read and are left as they are: %s", session_id, error)  # noqa: TRY400 - no bug of ours
        return Figures(), {"detail": f"the sample file cannot be read ({type(error).__name__}); it is left as it is"}
    return figures, {"detail": "no stream, or one that could not be settled yet"}


def _settle_late(database: Database, store: SampleStore, session_id: str) -> None:
    """Settle the stream of a closed session whose Parquet file was not made, or whose stream was not removed."""
    settled = _settled(store, session_id, Figures())
    if settled is None:
        return
    with database.write() as db:
        if not settled.is_whole:
            audit.append(db, _repaired(session_id, settled))
        audit.append(
            db, Event(actor=SYSTEM, action="samples.settled", session_id=session_id, detail=settled.audit_detail)
        )
    _forget(store, session_id, settled)


def _settled(store: SampleStore, session_id: str, figures: Figures) -> Settlement | None:
    try:
        settled = store.settle(session_id, figures.add)
    except _unreadable() as error:
        logger.warning("the samples of session %s stay in their stream: %s", session_id, error)
        return None
    if not settled.is_whole:
        logger.warning(
            "the samples of session %s end after %d rows: %s; %d bytes behind them could not be read%s",
            session_id,
            0 if settled.stored is None else settled.stored.rows,
            settled.detail,
            settled.lost_bytes,
            "" if settled.kept_aside is None else f" and are kept in {settled.kept_aside}",
        )
    return settled


def _repaired(session_id: str, settled: Settlement) -> Event:
    """Return the audit event of lost samples; a tail torn by a kill is not a fault, damage is."""
    return Event(
        actor=SYSTEM,
        action="samples.repaired",
        outcome="done" if settled.kept_aside is None else "failed",
        session_id=session_id,
        detail=settled.audit_detail,
    )


def _forget(store: SampleStore, session_id: str, settled: Settlement | None) -> None:
    if settled is None:
        return
    try:
        store.forget_stream(session_id)
    except OSError as error:
        logger.warning("the stream of session %s could not be removed: %s", session_id, error.strerror)


def _unreadable() -> tuple[type[Exception], ...]:
    """Return the errors of a damaged sample file; they must not keep the service from starting."""
    return (NoSamplesError, pa.ArrowException, OSError, ValueError, KeyError, TypeError)
