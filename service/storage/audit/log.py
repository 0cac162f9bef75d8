"""Writing of events and refusals to the audit log, and reading of pages.

HTTP schemas of the audit: rows, pages, and the result of a verification.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from typing import Literal

from pydantic import AwareDatetime, Field

from engine.core.errors import TidegateError
from service.core.list_filters import ALL_ROWS, AuditFilter
from service.core.schemas.base import Answer, Problem
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.verification import Breakage
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow


class AuditEntry(Answer):
    """One row of the append-only log."""

    sequence: int
    at: AwareDatetime
    actor: str
    action: str
    outcome: Literal["done", "requested", "refused", "failed"]
    session_id: str | None
    detail: dict[str, object]
    previous_hash: str
    hash: str


class AuditPage(Answer):
    """Newest first."""

    items: list[AuditEntry]
    next_cursor: str | None


class AuditVerification(Answer):
    """Whether the chain of hashes holds; names the first broken row, and what was done to it, when it does not."""

    is_intact: bool = Field(description="Nothing broken as far as was walked")
    is_complete: bool = Field(description="Walked to the newest row; else go on with `after` = `checked_to`")
    rows: int = Field(description="Rows that hold")
    checked_to: int = Field(description="The last row that holds")
    head_hash: str
    first_broken_sequence: int | None = Field(description="None too where only the file of anchors is broken")
    breakage: Breakage | None = Field(description="What the chain looks like where it breaks")
    detail: str
    notes: list[str] = Field(description="What a person should know besides, such as restored backups")


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
