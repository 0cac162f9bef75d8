"""The audit log: append-only rows, each sealed with a SHA-256 over its own content and the seal before it.

A row that is changed, removed or put in between breaks the chain at that place, and :func:`verify` names it. What a
chain cannot show by itself is that its newest rows were cut off; whoever keeps ``head_hash`` elsewhere can.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.db.base import utc_text
from service.db.models import AuditRow

GENESIS_HASH = "0" * 64
SYSTEM = "tidegate"
Outcome = Literal["done", "requested", "refused", "failed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that changed, or was refused: who, what, with which outcome."""

    actor: str
    action: str
    outcome: Outcome = "done"
    session_id: str | None = None
    detail: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification:
    """What a walk along the chain found."""

    rows: int
    head_hash: str
    first_broken_sequence: int | None = None
    detail: str = "every row follows from the one before"


def canonical_json(value: object) -> str:
    """Write JSON in the one way that is hashed: sorted keys, no spaces, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def append(db: Session, event: Event, at: datetime | None = None) -> AuditRow:
    """Add the next row; the session must hold the write lock (``Database.write``)."""
    last = db.execute(select(AuditRow.sequence, AuditRow.hash).order_by(AuditRow.sequence.desc()).limit(1)).first()
    row = AuditRow(
        sequence=1 if last is None else last.sequence + 1,
        at=utc_text(at or datetime.now(UTC)),
        actor=event.actor,
        action=event.action,
        outcome=event.outcome,
        session_id=event.session_id,
        detail=canonical_json(event.detail),
        previous_hash=GENESIS_HASH if last is None else last.hash,
    )
    row.hash = seal(row)
    db.add(row)
    db.flush()
    return row


def seal(row: AuditRow) -> str:
    """Hash a row's content together with the seal before it."""
    content = [row.sequence, row.at, row.actor, row.action, row.outcome, row.session_id, row.detail, row.previous_hash]
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()


def verify(db: Session) -> Verification:
    """Walk the whole chain and name the first row that does not follow from the one before."""
    previous_hash = GENESIS_HASH
    rows = 0
    for row in db.scalars(select(AuditRow).order_by(AuditRow.sequence).execution_options(yield_per=1000)):
        broken = _break(row, rows + 1, previous_hash)
        if broken is not None:
            return Verification(rows=rows, head_hash=previous_hash, first_broken_sequence=row.sequence, detail=broken)
        previous_hash = row.hash
        rows += 1
        db.expunge(row)
    return Verification(rows=rows, head_hash=previous_hash)


def _break(row: AuditRow, expected_sequence: int, previous_hash: str) -> str | None:
    if row.sequence != expected_sequence:
        return f"row {expected_sequence} is missing before row {row.sequence}"
    if row.previous_hash != previous_hash:
        return f"row {row.sequence} does not follow from the row before it"
    if row.hash != seal(row):
        return f"row {row.sequence} was changed after it was written"
    return None
