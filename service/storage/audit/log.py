"""Writing of events and refusals to the audit log, and reading of pages."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime

from engine.core.errors import TidegateError
from service.core.list_filters import ALL_ROWS, AuditFilter
from service.core.schemas.problems import Problem
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.schemas import AuditEntry, AuditPage
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow


class AuditLog:
    """Reads and writes the audit table, one transaction per call."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def write(self, event: Event) -> None:
        """Append one row and commit it; raise SQLAlchemyError if the database fails."""
        with self._database.write() as db:
            audit.append(db, event)

    @contextmanager
    def refusals(
        self, *, actor: str, action: str, session_id: str | None = None, detail: Mapping[str, object] | None = None
    ) -> Iterator[None]:
        """Audit a TidegateError that the block raises as a refusal, and re-raise it."""
        try:
            yield
        except TidegateError as error:
            found = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
            content = {**(detail or {}), "code": error.code, "message": str(error), **found}
            self.write(Event(actor=actor, action=action, outcome="refused", session_id=session_id, detail=content))
            raise

    def refused(self, *, actor: str, action: str, session_id: str | None, problem: Problem) -> None:
        """Audit a call that was refused before it was executed."""
        detail = problem.model_dump(include={"code", "detail", "field", "value", "bound"})
        self.write(Event(actor=actor, action=action, outcome="refused", session_id=session_id, detail=detail))

    def page(self, cursor: str | None, limit: int, session_id: str | None, wanted: AuditFilter = ALL_ROWS) -> AuditPage:
        """Return one page of rows, newest first, and the cursor of the next."""
        with self._database.read() as db:
            rows, next_cursor = queries.audit_page(db, cursor, limit, session_id, wanted)
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
