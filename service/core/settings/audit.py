"""Settings of the audit, ``audit_``: anchors, clock changes and the log file."""

from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings

ANCHOR_NAME = "audit-anchors.jsonl"


class AuditSettings(BaseSettings):
    """Settings of the audit; a part of :class:`service.core.settings.settings.Settings`."""

    data_dir: Path = Path("data")
    audit_anchor_file: Path | None = Field(
        default=None,
        description="File of the audit's anchors, best on another machine's share; default: audit-anchors.jsonl in the "
        "data folder",
    )
    audit_anchor_interval_s: float = Field(
        default=60.0, ge=1.0, le=3600.0, description="Longest interval between anchors while rows are added"
    )
    audit_clock_jump_ms: float = Field(
        default=500.0,
        ge=10.0,
        le=60_000.0,
        description="Change of the wall clock against the monotonic clock beyond which the audit records it as set",
    )
    audit_log_dir: Path | None = Field(
        default=None, description="Audit rows also as JSON lines in this folder, for the site's log collector"
    )
    audit_log_max_mb: int = Field(
        default=10, ge=1, le=1000, description="Size beyond which a file is followed by another [MB]"
    )
    audit_log_files: int = Field(default=5, ge=1, le=100, description="Files that are kept")
    audit_log_patients: bool = Field(default=False, description="The files contain details that name a patient")

    @property
    def anchor_file(self) -> Path:
        """The file of anchors."""
        return self.audit_anchor_file or self.data_dir / ANCHOR_NAME
