"""What a start finds of the process before: sessions that nobody closed, streams that nobody made Parquet of.

Every step can be done again: a start that is killed in the middle leaves it to the next one.
"""

import logging
from datetime import UTC, datetime

import pyarrow as pa

from service import audit
from service.audit import SYSTEM, Event
from service.db import repository
from service.db.engine import Database
from service.figures import Figures
from service.samples.shelf import SampleShelf, Settlement
from service.samples.walk import NoSamplesError
from service.session_events import closing_event

logger = logging.getLogger(__name__)

UNREADABLE = (NoSamplesError, pa.ArrowException, OSError, ValueError, KeyError, TypeError)
"""What a file may do that a disk or somebody has damaged: no reason for a start to fail, and the next one with it."""
INTERRUPTED = "the service ended while this session ran"


def close_interrupted(database: Database, shelf: SampleShelf) -> None:
    """Close what a killed process left running, and settle the streams it left; called once at start."""
    shelf.sweep()
    with database.read() as db:
        running = [row.id for row in repository.running_sessions(db)]
    for session_id in running:
        _close(database, shelf, session_id)
    for session_id in shelf.left_streams():
        _settle_late(database, shelf, session_id)


def _close(database: Database, shelf: SampleShelf, session_id: str) -> None:
    """Write a session's end down, with the figures of what it left."""
    figures = Figures()
    settled = _settled(shelf, session_id, figures) if session_id in shelf.left_streams() else None
    said = {} if settled is None else settled.said
    if settled is None:
        figures, said = _counted(shelf, session_id)
    with database.write() as db:
        row = repository.session_row(db, session_id)
        row.status, row.status_detail, row.ended_at = "interrupted", INTERRUPTED, datetime.now(UTC)
        figures.transitions = repository.transition_count(db, session_id)
        summary = figures.summary()
        row.summary = summary.model_dump_json()
        if settled is not None and not settled.is_whole:
            audit.append(db, _repaired(session_id, settled))
        audit.append(db, closing_event(row, summary, said, actor=SYSTEM))
    _forget(shelf, session_id, settled)


def _counted(shelf: SampleShelf, session_id: str) -> tuple[Figures, dict[str, object]]:
    """Count what can be read where nothing was settled; a session whose file cannot be read is closed all the same."""
    figures = Figures()
    try:
        for batch in shelf.batches(session_id):
            figures.add(batch)
    except UNREADABLE as error:
        logger.error("the samples of session %s cannot be read and are left as they are: %s", session_id, error)  # noqa: TRY400 - no bug of ours
        return Figures(), {"detail": f"the sample file cannot be read ({type(error).__name__}); it is left as it is"}
    return figures, {"detail": "no stream, or one that could not be settled yet"}


def _settle_late(database: Database, shelf: SampleShelf, session_id: str) -> None:
    """Settle the stream of a session that was closed: its Parquet could not be made, or the stream not be removed."""
    settled = _settled(shelf, session_id, Figures())
    if settled is None:
        return
    with database.write() as db:
        if not settled.is_whole:
            audit.append(db, _repaired(session_id, settled))
        audit.append(db, Event(actor=SYSTEM, action="samples.settled", session_id=session_id, detail=settled.said))
    _forget(shelf, session_id, settled)


def _settled(shelf: SampleShelf, session_id: str, figures: Figures) -> Settlement | None:
    try:
        settled = shelf.settle(session_id, figures.add)
    except UNREADABLE as error:
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
    """Say what was cut off; a tail that a kill tore is no fault, damage is."""
    return Event(
        actor=SYSTEM,
        action="samples.repaired",
        outcome="done" if settled.kept_aside is None else "failed",
        session_id=session_id,
        detail=settled.said,
    )


def _forget(shelf: SampleShelf, session_id: str, settled: Settlement | None) -> None:
    if settled is None:
        return
    try:
        shelf.forget_stream(session_id)
    except OSError as error:
        logger.warning("the stream of session %s could not be removed: %s", session_id, error.strerror)
