"""HTTP schemas of the audit: rows, pages, and the result of a verification."""

from typing import Literal

from pydantic import AwareDatetime, Field

from service.core.schemas.base import Answer
from service.storage.audit.verification import Breakage


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
