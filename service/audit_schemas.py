"""What is told of the audit's chain."""

from pydantic import Field

from service.audit.walk import Breakage
from service.schema_base import Answer


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
