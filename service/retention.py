"""What may be removed of what was measured, and its removal: by age alone, oldest first, each with a row in the audit.

Samples and raw recordings of a session that is over may go once they are older than the site keeps them; a site that
sets nothing keeps everything. Never an open session's, never what no session is known of, never the audit.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import select

from service import audit
from service.audit import SYSTEM, Event
from service.db.base import utc_text
from service.db.engine import Database
from service.db.models import SessionRow
from service.db.preparing import SAMPLES_FOLDER
from service.db.repository import OPEN_STATUSES
from service.samples.durable import file_sha256, sync_folder
from service.session_tape import FOLDER as TAPES_FOLDER
from service.session_tape import RAW_FOLDER
from service.storage_settings import StorageSettings

logger = logging.getLogger(__name__)

KINDS = {SAMPLES_FOLDER: "samples", TAPES_FOLDER: "tape", RAW_FOLDER: "raw"}
"""Folders that hold files named after their session, and what each holds."""
SETTING_OF = {"samples": "retain_samples_days", "tape": "retain_samples_days", "raw": "retain_raw_days"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Holding:
    """One file of a session that is over."""

    kind: str
    session_id: str
    ended_at: datetime
    path: Path


def holdings(data_dir: Path, ended: Mapping[str, datetime]) -> list[Holding]:
    """List what is held of sessions that are over, oldest first."""
    found = [
        Holding(kind=kind, session_id=session_id, ended_at=ended[session_id], path=path)
        for folder, kind in KINDS.items()
        for path in sorted((data_dir / folder).glob("*"))
        if path.is_file() and (session_id := path.name.partition(".")[0]) in ended
    ]
    return sorted(found, key=lambda one: (one.ended_at, one.session_id))


def removable(found: Sequence[Holding], settings: StorageSettings, now: datetime) -> list[tuple[Holding, str]]:
    """Choose what is older than the site keeps it, and name the rule."""
    chosen = []
    for one in found:
        name = SETTING_OF[one.kind]
        days: int = getattr(settings, name)
        if days and now - one.ended_at > timedelta(days=days):
            chosen.append((one, f"{name} is {days}"))
    return chosen


def ended_sessions(database: Database) -> dict[str, datetime]:
    """When each session ended that is over."""
    query = select(SessionRow.id, SessionRow.ended_at).where(
        SessionRow.status.not_in(OPEN_STATUSES), SessionRow.ended_at.is_not(None)
    )
    with database.read() as db:
        return {session_id: ended_at for session_id, ended_at in db.execute(query) if ended_at is not None}


def remove_old(database: Database, data_dir: Path, settings: StorageSettings, now: datetime) -> list[Holding]:
    """Remove what may go; returns what went."""
    if not (settings.retain_samples_days or settings.retain_raw_days):
        return []
    chosen = removable(holdings(data_dir, ended_sessions(database)), settings, now)
    for one, rule in chosen:
        _remove(database, one, rule)
    return [one for one, _ in chosen]


def _remove(database: Database, one: Holding, rule: str) -> None:
    """Write the removal down, then remove: a kill in between leaves a file that the next turn removes."""
    detail = {
        "file": one.path.name,
        "bytes": one.path.stat().st_size,
        "sha256": file_sha256(one.path),
        "ended_at": utc_text(one.ended_at),
        "rule": rule,
    }
    with database.write() as db:
        audit.append(db, Event(actor=SYSTEM, action=f"{one.kind}.removed", session_id=one.session_id, detail=detail))
    one.path.unlink(missing_ok=True)
    sync_folder(one.path.parent)
    logger.warning("removed %s of session %s: %s", one.path.name, one.session_id, rule)
