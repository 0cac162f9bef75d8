"""Verification of the chain in the database against the anchor file, in full or from the newest anchor on.

Events of a service start: the settings, their changes since the last start, and a clock that was set back.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta

from pydantic_settings import BaseSettings
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.storage.audit.anchors import AnchorFile, AnchorReport, Reached
from service.storage.audit.chain import COLUMNS, SYSTEM, Event, Link, canonical_json
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
from service.storage.believed_time import latest_time
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

START = "service.start"
SETTINGS_CHANGED = "settings.changed"
CLOCK_CHANGED = "clock.changed"
REDACTED = "(not told)"
NO_SETTING = "(there was no such setting)"
SECRET_NAME = re.compile(r"(?:^|_)(?:password|secret|token|key)(?:_|$)")
TAIL_ROWS = 100_000
"""Rows that the check at start-up reads at most after the newest anchor."""
WITHOUT_ANCHORS = (
    "not compared with anchors: rows cut off at the end are not found; compare rows and head with the room's"
)
LOST_FILE = (
    "the anchor file does not reach as far as the newest start of the service saw it reach: lines were cut off it, "
    "or another file lies in its place"
)


def redacted_settings(settings: BaseSettings) -> dict[str, object]:
    """Return the settings for the audit; secrets, by type or by name, are replaced by a fixed text."""
    recorded = settings.model_dump(mode="json")
    return {name: _redacted(name, value) for name, value in recorded.items()}


def settings_sha256(recorded: Mapping[str, object]) -> str:
    """Return the SHA-256 of redacted settings, as hex."""
    return hashlib.sha256(canonical_json(recorded).encode()).hexdigest()


def last_start(db: Session) -> dict[str, object]:
    """Return the detail of the newest start; empty before the first or if it is unreadable."""
    query = select(AuditRow.detail).where(AuditRow.session_id.is_(None), AuditRow.action == START)
    found = db.scalar(query.order_by(AuditRow.sequence.desc()).limit(1))
    try:
        detail = json.loads(found or "{}")
    except ValueError:
        return {}  # a tampered row: the verification reports it
    return detail if isinstance(detail, dict) else {}


def changes(before: Mapping[str, object], recorded: Mapping[str, object]) -> Event | None:
    """Return an event with the settings that changed since the previous start; None if none did."""
    old = before.get("settings")
    if not isinstance(old, dict):
        return None
    found = {
        name: {"old": old.get(name, NO_SETTING), "new": recorded.get(name, NO_SETTING)}
        for name in sorted({*old, *recorded})
        if name not in old or name not in recorded or old[name] != recorded[name]
    }
    if not found:
        return None
    detail = {"changed": found, "old_version": before.get("version")}
    return Event(actor=SYSTEM, action=SETTINGS_CHANGED, detail=detail)


def reached_before(before: Mapping[str, object]) -> Reached | None:
    """Return the extent of the anchor file at the previous start; None if it was not recorded."""
    recorded = before.get("anchors")
    if not isinstance(recorded, dict):
        return None
    size_bytes, line_sha256 = recorded.get("size_bytes"), recorded.get("line_sha256")
    if not isinstance(size_bytes, int) or not isinstance(line_sha256, str):
        return None
    return Reached(size_bytes=size_bytes, line_sha256=line_sha256)


def clock_went_back(db: Session, now: datetime, tolerance_s: float) -> Event | None:
    """Return an event if the system clock is earlier than the audit's latest time by more than the tolerance [s]."""
    latest = latest_time(db)
    if latest is None or latest - now <= timedelta(seconds=tolerance_s):
        return None
    return clock_event(before=latest, after=now, seen="at start: the latest time in the audit is later than now")


def clock_event(*, before: datetime, after: datetime, seen: str) -> Event:
    """Return the event of a clock step: the expected time, the new time, and their difference [ms]."""
    detail = {
        "before": before.astimezone(UTC).isoformat(),
        "after": after.astimezone(UTC).isoformat(),
        "jump_ms": round((after - before).total_seconds() * 1000.0, 3),
        "seen": seen,
    }
    return Event(actor=SYSTEM, action=CLOCK_CHANGED, detail=detail)


def _redacted(name: str, value: object) -> object:
    is_secret = SECRET_NAME.search(name) is not None and not name.endswith(("_file", "_dir"))
    return REDACTED if is_secret and isinstance(value, str) else value


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
