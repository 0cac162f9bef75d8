"""The same Idempotency-Key with the same request gives the same answer, also after a restart; refusals are not kept.

A key belongs to whoever sent it: another caller's is another key. Kept for as long as the site says
(`service.contract_settings`), and the newest `MOST_KEYS` of a caller and a call.
"""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TypeVar

from pydantic import BaseModel
from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from service.db.engine import Database
from service.db.models import IdempotencyRow
from service.errors import IdempotencyError, IdempotencyInProgressError

AnswerT = TypeVar("AnswerT", bound=BaseModel)
HEADER = "Idempotency-Key"
MOST_KEYS = 1_000
"""Of one caller and one call; the oldest go first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CallersKey:
    """An Idempotency-Key and whose it is."""

    caller: str
    key: str

    @property
    def prefix(self) -> str:
        """What all keys of this caller begin with, as they are stored."""
        return f"{_digest(self.caller)[:32]}."

    @property
    def stored(self) -> str:
        """How it is stored: of one length whatever was sent."""
        return f"{self.prefix}{_digest(self.key)}"


class InProgress:
    """The keys of one call that are being worked on: a second request with one is refused, not done again."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._keys: set[CallersKey] = set()

    @contextmanager
    def only(self, key: CallersKey | None) -> Iterator[None]:
        """Do one at a time; raise IdempotencyInProgressError beside another."""
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
    """Return what was answered to this key; raise IdempotencyError when that was another request."""
    row = None if key is None else db.get(IdempotencyRow, (route, key.stored))
    if key is None or row is None:
        return None
    if row.request_sha256 != hashlib.sha256(request).hexdigest():
        msg = "this Idempotency-Key was used with another request: use a new key for a new request"
        raise IdempotencyError(msg, field=HEADER, value=key.key, bound="used with one request only")
    return kind.model_validate_json(row.answer)


def keep_answer(db: Session, route: str, key: CallersKey | None, request: bytes, answer: BaseModel) -> None:
    """Remember an answer, in the transaction that made it true."""
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
    """Remove what is older than the site keeps it; returns how many."""
    old = IdempotencyRow.created_at < now - timedelta(days=days)
    with database.read() as db:
        if db.scalar(select(func.count()).select_from(IdempotencyRow).where(old)) == 0:
            return 0
    with database.write() as db:
        return len(db.execute(delete(IdempotencyRow).where(old).returning(IdempotencyRow.key)).all())


def _make_room(db: Session, route: str, key: CallersKey) -> None:
    mine = (IdempotencyRow.route == route, IdempotencyRow.key.startswith(key.prefix, autoescape=True))
    count = db.scalar(select(func.count()).select_from(IdempotencyRow).where(*mine)) or 0
    if count < MOST_KEYS:
        return
    oldest = select(IdempotencyRow.key).where(*mine).order_by(IdempotencyRow.created_at).limit(count - MOST_KEYS + 1)
    gone = db.scalars(oldest).all()
    db.execute(delete(IdempotencyRow).where(IdempotencyRow.route == route, IdempotencyRow.key.in_(gone)))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
