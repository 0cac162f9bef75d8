"""One link of the audit chain: what happened, sealed with a SHA-256 over its own content and the seal before it.

A row that is changed, removed or put in between breaks the chain at that place; `service.audit.walk` names it. What a
chain cannot show by itself is that its newest rows were cut off, or that somebody sealed all of it anew: the heads kept
outside the database do (`service.audit.anchors`).
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Literal, NamedTuple, cast

from sqlalchemy import Table, insert, select
from sqlalchemy.orm import Session

from service.access import behalf
from service.db.base import utc_text
from service.db.models import AuditRow

GENESIS_HASH = "0" * 64
SYSTEM = "tidegate"
Outcome = Literal["done", "requested", "refused", "failed"]

_encode = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that changed, or was refused: who, what, with which outcome."""

    actor: str
    action: str
    outcome: Outcome = "done"
    session_id: str | None = None
    detail: Mapping[str, object] = field(default_factory=dict)


class Link(NamedTuple):
    """A row of the audit as the walk and the exports read it; ``detail`` is the text that was sealed."""

    sequence: int
    at: str
    actor: str
    action: str
    outcome: str
    session_id: str | None
    detail: str
    previous_hash: str
    hash: str


COLUMNS = tuple(getattr(AuditRow, name) for name in Link._fields)
_LAST = select(AuditRow.sequence, AuditRow.hash).order_by(AuditRow.sequence.desc()).limit(1)
_INSERT = insert(cast("Table", AuditRow.__table__))


def canonical_json(value: object) -> str:
    """Write JSON in the one way that is hashed: sorted keys, no spaces, no NaN."""
    return _encode(value)


def append(db: Session, event: Event, at: datetime | None = None) -> Link:
    """Add the next row; the session must hold the write lock (``Database.write``)."""
    last = db.execute(_LAST).first()
    link = Link(
        sequence=1 if last is None else last.sequence + 1,
        at=utc_text(at or datetime.now(UTC)),
        actor=event.actor,
        action=event.action,
        outcome=event.outcome,
        session_id=event.session_id,
        detail=canonical_json({**event.detail, **behalf.told()}),
        previous_hash=GENESIS_HASH if last is None else last.hash,
        hash="",
    )
    link = link._replace(hash=seal(link))
    db.execute(_INSERT, link._asdict())  # no object of the session's: a writer adds many
    return link


def seal(row: AuditRow | Link, *, sequence: int | None = None) -> str:
    """Hash a row's content together with the seal before it; ``sequence`` asks how it would be sealed elsewhere."""
    place = row.sequence if sequence is None else sequence
    content = [place, row.at, row.actor, row.action, row.outcome, row.session_id, row.detail, row.previous_hash]
    return hashlib.sha256(_encode(content).encode()).hexdigest()
