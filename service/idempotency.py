"""The same Idempotency-Key with the same request gives the same answer, also after a restart; refusals are not kept."""

import hashlib
from datetime import UTC, datetime
from typing import TypeVar

from pydantic import BaseModel
from sqlalchemy.orm import Session

from service.db.models import IdempotencyRow
from service.errors import IdempotencyError

AnswerT = TypeVar("AnswerT", bound=BaseModel)


def earlier_answer(db: Session, route: str, key: str | None, request: bytes, kind: type[AnswerT]) -> AnswerT | None:
    """Return what was answered to this key; raise IdempotencyError when that was another request."""
    row = None if key is None else db.get(IdempotencyRow, (route, key))
    if row is None:
        return None
    if row.request_sha256 != hashlib.sha256(request).hexdigest():
        msg = "this Idempotency-Key was used with another request: use a new key for a new request"
        raise IdempotencyError(msg, field="Idempotency-Key", value=key, bound="used with one request only")
    return kind.model_validate_json(row.answer)


def keep_answer(db: Session, route: str, key: str | None, request: bytes, answer: BaseModel) -> None:
    """Remember an answer, in the transaction that made it true."""
    if key is None:
        return
    db.add(
        IdempotencyRow(
            route=route,
            key=key,
            request_sha256=hashlib.sha256(request).hexdigest(),
            answer=answer.model_dump_json(),
            created_at=datetime.now(UTC),
        )
    )
