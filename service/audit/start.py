"""What a start of the service writes down of itself: its settings, and what somebody changed since the last start."""

import hashlib
import json
import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

from pydantic_settings import BaseSettings
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.audit.anchors import Reached
from service.audit.chain import SYSTEM, Event, canonical_json
from service.db.models import AuditRow

START = "service.start"
SETTINGS_CHANGED = "settings.changed"
CLOCK_CHANGED = "clock.changed"
NOT_TOLD = "(not told)"
NO_SETTING = "(there was no such setting)"
SECRET_NAME = re.compile(r"(?:^|_)(?:password|secret|token|key)(?:_|$)")


def told_settings(settings: BaseSettings) -> dict[str, object]:
    """Write the settings as an audit may keep them: what is a secret, or is called one, is not told."""
    told = settings.model_dump(mode="json")
    return {name: _told(name, value) for name, value in told.items()}


def settings_sha256(told: Mapping[str, object]) -> str:
    """Hash settings as told."""
    return hashlib.sha256(canonical_json(told).encode()).hexdigest()


def last_start(db: Session) -> dict[str, object]:
    """Read what the newest start wrote down of itself; empty before the first."""
    query = select(AuditRow.detail).where(AuditRow.session_id.is_(None), AuditRow.action == START)
    found = db.scalar(query.order_by(AuditRow.sequence.desc()).limit(1))
    try:
        detail = json.loads(found or "{}")
    except ValueError:
        return {}  # somebody edited it: the walk names the row
    return detail if isinstance(detail, dict) else {}


def changes(before: Mapping[str, object], told: Mapping[str, object]) -> Event | None:
    """Compare with the settings of the start before; None where nothing differs, or nothing was before."""
    old = before.get("settings")
    if not isinstance(old, dict):
        return None
    found = {
        name: {"old": old.get(name, NO_SETTING), "new": told.get(name, NO_SETTING)}
        for name in sorted({*old, *told})
        if name not in old or name not in told or old[name] != told[name]
    }
    if not found:
        return None
    detail = {"changed": found, "old_version": before.get("version")}
    return Event(actor=SYSTEM, action=SETTINGS_CHANGED, detail=detail)


def reached_before(before: Mapping[str, object]) -> Reached | None:
    """Return how far the start before saw the file of heads reach."""
    told = before.get("anchors")
    if not isinstance(told, dict):
        return None
    size_bytes, line_sha256 = told.get("size_bytes"), told.get("line_sha256")
    if not isinstance(size_bytes, int) or not isinstance(line_sha256, str):
        return None
    return Reached(size_bytes=size_bytes, line_sha256=line_sha256)


def clock_went_back(db: Session, now: datetime, tolerance_s: float) -> Event | None:
    """Look whether the wall clock is before the newest row: it was set while nothing ran."""
    text = db.scalar(select(AuditRow.at).order_by(AuditRow.sequence.desc()).limit(1))
    try:
        newest = None if text is None else datetime.fromisoformat(text)
    except ValueError:
        return None
    if newest is None or newest.tzinfo is None or newest - now <= timedelta(seconds=tolerance_s):
        return None
    return clock_event(before=newest, after=now, seen="at start: the newest row is later than now")


def clock_event(*, before: datetime, after: datetime, seen: str) -> Event:
    """Put a set clock into the audit's words: the wall clock as it should have been, and as it is."""
    detail = {
        "before": before.astimezone(UTC).isoformat(),
        "after": after.astimezone(UTC).isoformat(),
        "jump_ms": round((after - before).total_seconds() * 1000.0, 3),
        "seen": seen,
    }
    return Event(actor=SYSTEM, action=CLOCK_CHANGED, detail=detail)


def _told(name: str, value: object) -> object:
    is_secret = SECRET_NAME.search(name) is not None and not name.endswith(("_file", "_dir"))
    return NOT_TOLD if is_secret and isinstance(value, str) else value
