"""One link of the audit chain: an event with the SHA-256 of its content and of the link before.

A changed, removed or inserted row breaks the chain there; `service.storage.audit.verification` finds it. The chain
alone does not show that its newest rows were deleted or that all of it was hashed anew; the heads outside the database
do (`service.storage.audit.anchors`).

For whom a machine acts, and which part of its request body was ignored; added to each audit row of the request.

Context variables: each request has its own values, and the layers between router and audit need not pass them.
"""

import hashlib
import json
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Literal, NamedTuple, cast

from sqlalchemy import Table, insert, select
from sqlalchemy.orm import Session

from service.storage.database.base import utc_text
from service.storage.database.tables import AuditRow

GENESIS_HASH = "0" * 64
SYSTEM = "tidegate"
Outcome = Literal["done", "requested", "refused", "failed"]

_encode = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode
_LAST = select(AuditRow.sequence, AuditRow.hash).order_by(AuditRow.sequence.desc()).limit(1)
_INSERT = insert(cast("Table", AuditRow.__table__))
_on_behalf_of: ContextVar[str | None] = ContextVar("tidegate_on_behalf_of", default=None)
_unread: ContextVar[str | None] = ContextVar("tidegate_unread", default=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """An auditable event; ``detail`` must be JSON without NaN."""

    actor: str
    action: str
    outcome: Outcome = "done"
    session_id: str | None = None
    detail: Mapping[str, object] = field(default_factory=dict)


class Link(NamedTuple):
    """An audit row as plain values; ``detail`` is the exact JSON text that was hashed."""

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


def canonical_json(value: object) -> str:
    """Return canonical JSON: sorted keys, no spaces; raise ValueError for NaN or infinity."""
    return _encode(value)


def append(db: Session, event: Event, at: datetime | None = None) -> Link:
    """Append the next row and return it; the session must hold the write lock (``Database.write``)."""
    last = db.execute(_LAST).first()
    link = Link(
        sequence=1 if last is None else last.sequence + 1,
        at=utc_text(at or datetime.now(UTC)),
        actor=event.actor,
        action=event.action,
        outcome=event.outcome,
        session_id=event.session_id,
        detail=canonical_json({**event.detail, **audit_fields()}),
        previous_hash=GENESIS_HASH if last is None else last.hash,
        hash="",
    )
    link = link._replace(hash=seal(link))
    db.execute(_INSERT, link._asdict())  # no object of the session's: a writer adds many
    return link


def seal(row: AuditRow | Link, *, sequence: int | None = None) -> str:
    """Return the SHA-256 over a row's content and the previous hash; ``sequence`` replaces the row's own number."""
    place = row.sequence if sequence is None else sequence
    content = [place, row.at, row.actor, row.action, row.outcome, row.session_id, row.detail, row.previous_hash]
    return hashlib.sha256(_encode(content).encode()).hexdigest()


def act_for(person: str) -> None:
    """Set the person on whose behalf the rest of this request acts."""
    _on_behalf_of.set(person)


def leave_unread(what: str) -> None:
    """Record which part of this request's body was ignored."""
    _unread.set(what)


def audit_fields() -> dict[str, object]:
    """Return the fields to add to an audit row's detail; empty if nothing was set."""
    found = {"on_behalf_of": _on_behalf_of.get(), "body_not_read": _unread.get()}
    return {name: value for name, value in found.items() if value is not None}
