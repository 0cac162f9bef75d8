"""Verification of the chain in the database against the anchor file, in full or from the newest anchor on."""

from collections.abc import Callable
from dataclasses import replace

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.storage.audit.anchors import AnchorFile, AnchorReport
from service.storage.audit.chain import COLUMNS, Link
from service.storage.audit.startup import last_start, reached_before
from service.storage.audit.verification import (
    Breakage,
    Head,
    Reader,
    Verification,
    Walk,
    head_sequence,
    pieces,
    read_links,
)
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

TAIL_ROWS = 100_000
"""Rows that the check at start-up reads at most after the newest anchor."""
WITHOUT_ANCHORS = (
    "not compared with anchors: rows cut off at the end are not found; compare rows and head with the room's"
)
LOST_FILE = (
    "the anchor file does not reach as far as the newest start of the service saw it reach: lines were cut off it, "
    "or another file lies in its place"
)


def check_whole(
    database: Database, file: AnchorFile, *, on_piece: Callable[[int], None] = lambda _rows: None
) -> Verification:
    """Verify the whole chain against the anchor file while others write; ``on_piece`` receives the rows so far."""
    report = file.report()
    with database.read() as db:  # after the file: every row that was anchored is there by now
        up_to, trouble = head_sequence(db), report.trouble or lost_lines(db, file, report)
    walk = Walk(file.heads(report.counts_from_byte))
    for links in pieces(reader(database), up_to=up_to):
        if not walk.take(links):
            break
        on_piece(walk.rows)
    return with_report(walk.end(), report, trouble)


def check_chain(database: Database, *, on_piece: Callable[[int], None] = lambda _rows: None) -> Verification:
    """Verify the whole chain without anchors, as of a replicated database: rows cut off at the end are not found."""
    with database.read() as db:
        up_to = head_sequence(db)
    walk = Walk()
    for links in pieces(reader(database), up_to=up_to):
        if not walk.take(links):
            break
        on_piece(walk.rows)
    found = walk.end()
    return replace(found, notes=(*found.notes, WITHOUT_ANCHORS))


def with_report(found: Verification, report: AnchorReport, trouble: str | None) -> Verification:
    """Merge the anchor file's result; a broken chain takes precedence over a broken file."""
    found = replace(found, notes=(*found.notes, *report.notes))
    if trouble is None or not found.is_intact:
        return found if trouble is None else replace(found, notes=(*found.notes, trouble))
    return replace(found, breakage=Breakage.ANCHORS, detail=trouble)


def lost_lines(db: Session, file: AnchorFile, report: AnchorReport) -> str | None:
    """Return a sentence if the file is shorter than the newest start recorded; None after a restore since then."""
    reached = reached_before(last_start(db))
    if reached is None or file.still_reaches(reached):
        return None
    return None if report.restores and is_first_since_restore(db, report.restores[-1].sequence) else LOST_FILE


def is_first_since_restore(db: Session, restored_sequence: int) -> bool:
    """Whether the newest start in the log is part of the restored backup."""
    query = select(AuditRow.sequence).where(AuditRow.session_id.is_(None), AuditRow.action == "service.start")
    newest = db.scalar(query.order_by(AuditRow.sequence.desc()).limit(1))
    return newest is not None and newest <= restored_sequence


def check_tail(database: Database, file: AnchorFile) -> str | None:
    """Verify the rows after the newest anchor; return what is wrong as a sentence, None if nothing is."""
    newest = file.last()
    with database.read() as db:
        reached = reached_before(last_start(db))
        is_lost = reached is not None and not file.still_reaches(reached)
        if is_lost and not (newest is not None and newest.kind == "restore"):
            return LOST_FILE
        anchored = None if newest is None else row_at(db, newest.sequence)
        end = head_sequence(db)
    if newest is None:
        return None
    if anchored is None or anchored.hash != newest.hash:
        return _unlike(newest.head, end)
    walk = Walk(after=anchored)
    for links in pieces(reader(database), after=anchored.sequence, up_to=anchored.sequence + TAIL_ROWS):
        if not walk.take(links):
            break
    return None if walk.broken is None else walk.broken.detail


def _unlike(head: Head, end: int) -> str:
    if end < head.sequence:
        return f"the audit ends with row {end}, and row {head.sequence} was anchored at {head.at}: rows were cut off"
    return f"row {head.sequence} is not the row that was anchored at {head.at}: the audit was changed, or replaced"


def row_at(db: Session, sequence: int) -> Link | None:
    """Return a row by its sequence; None if there is none."""
    found = db.execute(select(*COLUMNS).where(AuditRow.sequence == sequence)).first()
    return None if found is None else Link._make(found)


def reader(database: Database) -> Reader:
    """Return a reader with one database session per piece: a long read would block checkpoints and vacuum."""

    def read(after: int | None, limit: int) -> list[Link]:
        with database.read() as db:
            return read_links(db, after, limit)

    return read
