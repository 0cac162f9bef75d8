"""The whole check: the chain in the database, held against the heads outside it, and those against the chain."""

from collections.abc import Callable
from dataclasses import replace

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.audit.anchors import AnchorFile, AnchorReport
from service.audit.chain import COLUMNS, Link
from service.audit.start import last_start, reached_before
from service.audit.walk import Breakage, Head, Reader, Verification, Walk, head_sequence, pieces, read_links
from service.db.engine import Database
from service.db.models import AuditRow

TAIL_ROWS = 100_000
"""A start looks no further back than this, where the last head is older."""
LOST_FILE = (
    "the anchor file does not reach as far as the newest start of the service saw it reach: lines were cut off it, "
    "or another file lies in its place"
)


def check_whole(
    database: Database, file: AnchorFile, *, on_piece: Callable[[int], None] = lambda _rows: None
) -> Verification:
    """Walk the whole chain beside whoever writes to it, and hold it against the file of heads."""
    report = file.report()
    with database.read() as db:  # after the file: every row that was anchored is there by now
        up_to, trouble = head_sequence(db), report.trouble or lost_lines(db, file, report)
    walk = Walk(file.heads(report.counts_from_byte))
    for links in pieces(reader(database), up_to=up_to):
        if not walk.take(links):
            break
        on_piece(walk.rows)
    return with_report(walk.end(), report, trouble)


def with_report(found: Verification, report: AnchorReport, trouble: str | None) -> Verification:
    """Add what the file of heads has to say; a broken chain goes before a broken file."""
    found = replace(found, notes=(*found.notes, *report.notes))
    if trouble is None or not found.is_intact:
        return found if trouble is None else replace(found, notes=(*found.notes, trouble))
    return replace(found, breakage=Breakage.ANCHORS, detail=trouble)


def lost_lines(db: Session, file: AnchorFile, report: AnchorReport) -> str | None:
    """Whether the file reaches as far as the newest start saw; a database restored since knows another file."""
    reached = reached_before(last_start(db))
    if reached is None or file.still_reaches(reached):
        return None
    return None if report.restores and is_first_since_restore(db, report.restores[-1].sequence) else LOST_FILE


def is_first_since_restore(db: Session, restored_sequence: int) -> bool:
    """Whether the newest start in the log is one that came with the backup."""
    query = select(AuditRow.sequence).where(AuditRow.session_id.is_(None), AuditRow.action == "service.start")
    newest = db.scalar(query.order_by(AuditRow.sequence.desc()).limit(1))
    return newest is not None and newest <= restored_sequence


def check_tail(database: Database, file: AnchorFile) -> str | None:
    """Hold what was written since the newest head against it, quickly; say what is wrong, None for nothing."""
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
    """Read one row."""
    found = db.execute(select(*COLUMNS).where(AuditRow.sequence == sequence)).first()
    return None if found is None else Link._make(found)


def reader(database: Database) -> Reader:
    """Read pieces in sessions of their own: no reader may keep the database from being tidied up."""

    def read(after: int | None, limit: int) -> list[Link]:
        with database.read() as db:
            return read_links(db, after, limit)

    return read
