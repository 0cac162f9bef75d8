"""Stored answers by Idempotency-Key: the same key and request return the same answer, also after a restart.

Refusals are not stored. Keys are separate per caller. An answer is kept for the time in the site's settings
(`service.core.settings.groups`), and the newest `MAX_KEYS` of each caller and call.
"""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Generic, TypeVar

from pydantic import BaseModel
from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from service.core.errors import IdempotencyError, IdempotencyInProgressError
from service.storage.database.engine import Database
from service.storage.database.tables import IdempotencyRow

AnswerT = TypeVar("AnswerT", bound=BaseModel)
HEADER = "Idempotency-Key"
MAX_KEYS = 1_000
"""Stored answers of one caller and one call; the oldest are deleted first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CallersKey:
    """An Idempotency-Key and its caller."""

    caller: str
    key: str

    @property
    def prefix(self) -> str:
        """Common prefix of this caller's stored keys."""
        return f"{_digest(self.caller)[:32]}."

    @property
    def stored(self) -> str:
        """The stored form: hashes of caller and key, of fixed length."""
        return f"{self.prefix}{_digest(self.key)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class IdempotentAnswer(Generic[AnswerT]):
    """The answer to a creating call; ``is_replay`` if it is the stored answer to an earlier request."""

    answer: AnswerT
    is_replay: bool


class InProgress:
    """The keys of requests in progress, so that a concurrent second request is refused instead of executed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._keys: set[CallersKey] = set()

    @contextmanager
    def only(self, key: CallersKey | None) -> Iterator[None]:
        """Mark the key as in progress for the block; raise IdempotencyInProgressError if it already is."""
        if key is None:
            yield
            return
        with self._lock:
            if key in self._keys:
                bound = "sent again once the first request is answered"
                msg = "the first request with this Idempotency-Key is not answered yet: try again in a second"
                raise IdempotencyInProgressError(msg, field=HEADER, bound=bound)
            self._keys.add(key)
        try:
            yield
        finally:
            with self._lock:
                self._keys.discard(key)


def earlier_answer(
    db: Session, route: str, key: CallersKey | None, request: bytes, kind: type[AnswerT]
) -> AnswerT | None:
    """Return the stored answer, None if there is none; raise IdempotencyError if its request was different."""
    row = None if key is None else db.get(IdempotencyRow, (route, key.stored))
    if key is None or row is None:
        return None
    if row.request_sha256 != hashlib.sha256(request).hexdigest():
        msg = "this Idempotency-Key was used with another request: use a new key for a new request"
        raise IdempotencyError(msg, field=HEADER, value=key.key, bound="used with one request only")
    return kind.model_validate_json(row.answer)


def keep_answer(db: Session, route: str, key: CallersKey | None, request: bytes, answer: BaseModel) -> None:
    """Store an answer in the transaction of the change that it reports."""
    if key is None:
        return
    _make_room(db, route, key)
    db.add(
        IdempotencyRow(
            route=route,
            key=key.stored,
            request_sha256=hashlib.sha256(request).hexdigest(),
            answer=answer.model_dump_json(),
            created_at=datetime.now(UTC),
        )
    )


def forget_answers(database: Database, *, days: float, now: datetime) -> int:
    """Delete answers older than ``days``; return how many."""
    old = IdempotencyRow.created_at < now - timedelta(days=days)
    with database.read() as db:
        if db.scalar(select(func.count()).select_from(IdempotencyRow).where(old)) == 0:
            return 0
    with database.write() as db:
        return len(db.execute(delete(IdempotencyRow).where(old).returning(IdempotencyRow.key)).all())


def _make_room(db: Session, route: str, key: CallersKey) -> None:
    own_rows = (IdempotencyRow.route == route, IdempotencyRow.key.startswith(key.prefix, autoescape=True))
    count = db.scalar(select(func.count()).select_from(IdempotencyRow).where(*own_rows)) or 0
    if count < MAX_KEYS:
        return
    oldest = select(IdempotencyRow.key).where(*own_rows).order_by(IdempotencyRow.created_at).limit(count - MAX_KEYS + 1)
    gone = db.scalars(oldest).all()
    db.execute(delete(IdempotencyRow).where(IdempotencyRow.route == route, IdempotencyRow.key.in_(gone)))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
