"""Events of a service start: the settings, their changes since the last start, and a clock that was set back."""

import hashlib
import json
import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

from pydantic_settings import BaseSettings
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.storage.audit.anchors import Reached
from service.storage.audit.chain import SYSTEM, Event, canonical_json
from service.storage.database.tables import AuditRow

START = "service.start"
SETTINGS_CHANGED = "settings.changed"
CLOCK_CHANGED = "clock.changed"
REDACTED = "(not told)"
NO_SETTING = "(there was no such setting)"
SECRET_NAME = re.compile(r"(?:^|_)(?:password|secret|token|key)(?:_|$)")


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
    """Return an event if the system clock is earlier than the newest row by more than the tolerance [s]; else None."""
    text = db.scalar(select(AuditRow.at).order_by(AuditRow.sequence.desc()).limit(1))
    try:
        newest = None if text is None else datetime.fromisoformat(text)
    except ValueError:
        return None
    if newest is None or newest.tzinfo is None or newest - now <= timedelta(seconds=tolerance_s):
        return None
    return clock_event(before=newest, after=now, seen="at start: the newest row is later than now")


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
