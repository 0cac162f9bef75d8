"""Settings of the audit, ``audit_``: anchors, clock changes and forwarding to a syslog server."""

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings

from service.core.settings.beam import PREFIX

ANCHOR_NAME = "audit-anchors.jsonl"
SYSLOG_TLS_PORT = 6514
"""RFC 5425, 4.1."""


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
    audit_syslog_host: str | None = Field(
        default=None, min_length=1, max_length=253, description="Forwards audit events to this server, over TLS"
    )
    audit_syslog_port: int = Field(default=SYSLOG_TLS_PORT, ge=1, le=65535)
    audit_syslog_ca_file: Path | None = Field(
        default=None, description="CA certificates (PEM) for the syslog server; required with a host"
    )
    audit_syslog_cert_file: Path | None = Field(default=None, description="Client certificate for the syslog server")
    audit_syslog_key_file: Path | None = Field(default=None, description="Key of the client certificate")
    audit_syslog_timeout_s: float = Field(
        default=10.0, ge=0.5, le=60.0, description="Longest wait for the syslog server"
    )
    audit_syslog_patients: bool = Field(default=False, description="Forwarded events contain the patient's reference")

    @model_validator(mode="after")
    def _is_complete_server(self) -> Self:
        if self.audit_syslog_host is not None and self.audit_syslog_ca_file is None:
            msg = f"audit_syslog_ca_file is not given: {PREFIX}AUDIT_SYSLOG_HOST needs it to verify the server"
            raise ValueError(msg)
        if (self.audit_syslog_cert_file is None) != (self.audit_syslog_key_file is None):
            msg = "audit_syslog_cert_file and audit_syslog_key_file are one pair: give both, or none"
            raise ValueError(msg)
        return self

    @property
    def anchor_file(self) -> Path:
        """The file of anchors."""
        return self.audit_anchor_file or self.data_dir / ANCHOR_NAME
