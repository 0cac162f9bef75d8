"""Recovery at the start: write the transitions in a killed process's journal to the audit, where it lacks them.

Closing a session whose engine process died does the same. Each transition is appended once, in its order, at its own
time, marked as recovered. A start that is killed leaves the file to the next one; a file is removed only after its
transitions are committed. A damaged file is kept aside and reported. An engine that still writes after a time-out is
killed; if that fails, the service does not start, because two engines could command one line.
"""

import json
import logging
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NoReturn

from sqlalchemy import select
from sqlalchemy.orm import Session

from engine.control import Entry, JournalFormatError, JournalHeader, RecoveredJournal, boot_id, read_journal
from engine.core.errors import TidegateError
from service.engine_host.equipment import end_engines_holding
from service.sessions.records.audit_events import transition_event
from service.storage import audit
from service.storage.audit import SYSTEM, Event
from service.storage.database import queries
from service.storage.database.base import TimeAnchor
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow, SessionRow
from service.storage.files.journals import Journals, is_let_go, read_unless_in_use

logger = logging.getLogger(__name__)

RECOVERED, DAMAGED, MISSING = "journal.recovered", "journal.damaged", "journal.missing"
LEFT_BEHIND, IN_USE = "engine.left_behind", "journal.in_use"
FORESEEN = "recorded before the command to the beam line; whether the command was sent is not known"
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class JournalInUseError(TidegateError):
    """An engine of an earlier process may still drive the line, and cannot be killed."""


def recover_transitions(database: Database, journals: Journals) -> None:
    """Add missing transitions to the audit, from every journal found; called at the start, before sessions are closed.

    Raises
    ------
    JournalInUseError
        A process still holds one: its engine may live, and no session may begin beside it.
    """
    left = list(journals.left_behind())
    held = [path for path in left if not _is_let_go(database, journals.session_of(path), path)]
    if held:
        _refuse(database, [(path, journals.session_of(path)) for path in held])
    found = {session_id for path in left if (session_id := _recover(database, path))}
    with database.write() as db:
        for row in queries.running_sessions(db):
            if row.id not in found and not _has_event(db, row.id, MISSING):
                audit.append(db, _missing(row.id))


def _is_let_go(database: Database, session_id: str, path: Path) -> bool:
    """Wait until no process writes to a journal; kill the engines that still do after the waiting time."""
    if is_let_go(path):
        return True
    ended = end_engines_holding(path)
    if not ended:
        return False
    text = f"an engine of a service before this one still ran and was killed (process {ended})"
    logger.critical("session %s: %s", session_id, text)
    is_free = is_let_go(path)
    event = Event(
        actor=SYSTEM,
        action=LEFT_BEHIND,
        outcome="done" if is_free else "failed",
        session_id=session_id,
        detail={"processes": ended, "journal": path.name, "detail": text},
    )
    with database.write() as db:
        audit.append(db, event)
    return is_free


def _refuse(database: Database, held: list[tuple[Path, str]]) -> NoReturn:
    """Audit once per session that its journal is in use, and refuse the start."""
    names = ", ".join(path.name for path, _ in held)
    text = f"another process still holds {names}: an engine may run, and no other may begin beside it; end it first"
    logger.critical("%s", text)
    with database.write() as db:
        for path, session_id in held:
            if not _has_event(db, session_id, IN_USE):
                detail = {"journal": path.name, "detail": text}
                audit.append(
                    db, Event(actor=SYSTEM, action=IN_USE, outcome="failed", session_id=session_id, detail=detail)
                )
    raise JournalInUseError(text)


def recover_orphan(database: Database, path: Path) -> None:
    """Add missing transitions of a session whose engine process died while the service runs."""
    if path.exists():
        _recover(database, path)


def _recover(database: Database, path: Path) -> str | None:
    """Add one file's missing transitions; return its session id, None where the file is not trusted."""
    content = read_unless_in_use(path)
    if content is None:
        logger.warning("%s is in use by another process: it is left alone", path.name)
        return None
    try:
        kept = read_journal(content)
    except JournalFormatError as error:
        _put_aside(database, path, str(error))
        return None
    with database.write() as db:
        if db.get(SessionRow, kept.header.session_id) is None:
            # Of another database under the same folder's name: a backup that was put back, say. Not ours to remove.
            logger.warning("%s is of a session that this database does not know: it is left alone", path.name)
            return None
        lacking = _append_lacking(db, kept)
    if lacking:
        logger.warning("%d transitions of session %s were recovered", lacking, kept.header.session_id)
    path.unlink(missing_ok=True)
    return kept.header.session_id


def _append_lacking(db: Session, kept: RecoveredJournal) -> int:
    session_id, anchor = kept.header.session_id, _anchor(kept.header)
    known = _numbers(db, session_id)
    lacking = [entry for entry in kept.entries if entry.transition.number not in known]
    for entry in lacking:
        audit.append(db, _recovered(session_id, entry), anchor.utc(entry.transition.at_ns))
    is_damaged = bool(kept.damaged_slots or kept.missing_numbers)
    if (lacking or is_damaged) and not _has_event(db, session_id, RECOVERED):
        audit.append(db, _account(kept, lacking))
    return len(lacking)


def _recovered(session_id: str, entry: Entry) -> Event:
    """Return the audit event of a transition; a permit that was only prepared may not have reached the line."""
    transition = entry.transition
    if not entry.is_committed:
        detail = f"{transition.detail}; {FORESEEN}" if transition.detail else FORESEEN
        transition = replace(transition, detail=detail)
    event = transition_event(session_id, transition)
    unknown = {} if entry.is_committed else {"asserted_ns": None, "latency_ms": None}
    return replace(event, detail={**event.detail, **unknown, "recovered": True})


def _account(kept: RecoveredJournal, lacking: list[Entry]) -> Event:
    last = kept.entries[-1].transition.to_state.value if kept.entries else None
    return Event(
        actor=SYSTEM,
        action=RECOVERED,
        outcome="failed" if kept.damaged_slots or kept.missing_numbers else "done",
        session_id=kept.header.session_id,
        detail={
            "recovered": len(lacking),
            "kept": len(kept.entries),
            "last_state": last,
            "damaged_slots": list(kept.damaged_slots),
            "missing_numbers": list(kept.missing_numbers),
            "is_of_this_boot": kept.header.boot_id == boot_id(),
        },
    )


def _missing(session_id: str) -> Event:
    text = "the session's journal is gone, as after a restart of the machine: its last transitions may be lacking"
    return Event(actor=SYSTEM, action=MISSING, outcome="failed", session_id=session_id, detail={"detail": text})


def _put_aside(database: Database, path: Path, reason: str) -> None:
    """Preserve an unreadable file for inspection, after an audit entry."""
    aside = path.with_name(path.name + ".damaged")
    with database.write() as db:
        audit.append(
            db,
            Event(actor=SYSTEM, action=DAMAGED, outcome="failed", detail={"kept_as": aside.name, "detail": reason}),
        )
    logger.error("the journal %s cannot be read (%s) and is kept as %s", path.name, reason, aside.name)
    path.rename(aside)


def _numbers(db: Session, session_id: str) -> set[int]:
    rows = db.scalars(
        select(AuditRow.detail).where(AuditRow.session_id == session_id, AuditRow.action == queries.TRANSITION)
    )
    return {number for detail in rows if (number := json.loads(detail).get("number")) is not None}


def _has_event(db: Session, session_id: str, action: str) -> bool:
    query = select(AuditRow.sequence).where(AuditRow.session_id == session_id, AuditRow.action == action).limit(1)
    return db.scalar(query) is not None


def _anchor(header: JournalHeader) -> TimeAnchor:
    return TimeAnchor(at=EPOCH + timedelta(microseconds=header.anchor_utc_us), at_ns=header.anchor_ns)
