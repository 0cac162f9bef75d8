"""The audit log as the service uses it: events and refusals written down, pages read."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime

from engine.errors import TidegateError
from service import audit
from service.audit import Event
from service.audit_schemas import AuditEntry, AuditPage
from service.db import repository
from service.db.engine import Database
from service.db.models import AuditRow
from service.list_filters import ALL_ROWS, AuditFilter
from service.problem_schemas import Problem


class AuditLog:
    """Reads and writes the audit table in transactions of its own."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def write(self, event: Event) -> None:
        """Add one row, committed when this returns."""
        with self._database.write() as db:
            audit.append(db, event)

    @contextmanager
    def refusals(
        self, *, actor: str, action: str, session_id: str | None = None, detail: Mapping[str, object] | None = None
    ) -> Iterator[None]:
        """Write a refusal down when the block raises one, and let it pass on."""
        try:
            yield
        except TidegateError as error:
            found = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
            content = {**(detail or {}), "code": error.code, "message": str(error), **found}
            self.write(Event(actor=actor, action=action, outcome="refused", session_id=session_id, detail=content))
            raise

    def refused(self, *, actor: str, action: str, session_id: str | None, problem: Problem) -> None:
        """Write down a call that was refused before anyone acted on it."""
        detail = problem.model_dump(include={"code", "detail", "field", "value", "bound"})
        self.write(Event(actor=actor, action=action, outcome="refused", session_id=session_id, detail=detail))

    def page(self, cursor: str | None, limit: int, session_id: str | None, wanted: AuditFilter = ALL_ROWS) -> AuditPage:
        """List rows, newest first."""
        with self._database.read() as db:
            rows, next_cursor = repository.audit_page(db, cursor, limit, session_id, wanted)
            return AuditPage(items=[_entry(row) for row in rows], next_cursor=next_cursor)


def _entry(row: AuditRow) -> AuditEntry:
    return AuditEntry(
        sequence=row.sequence,
        at=datetime.fromisoformat(row.at),
        actor=row.actor,
        action=row.action,
        outcome=row.outcome,
        session_id=row.session_id,
        detail=json.loads(row.detail),
        previous_hash=row.previous_hash,
        hash=row.hash,
    )
