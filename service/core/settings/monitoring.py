"""Settings of monitoring: log format and level, certificate warning, readiness cache."""

from typing import Literal

from pydantic import Field
from pydantic_settings import BaseSettings

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]


class MonitoringSettings(BaseSettings):
    """Log and readiness; see docs/3-operate/monitoring.md."""

    log_format: LogFormat = Field(
        default="text", description="text for a terminal, json for a collector: one object per line"
    )
    log_level: LogLevel = Field(
        default="warning",
        description="Lowest level of Tidegate's log records; info has one line per request. Libraries"
        " log from warning on",
    )
    certificate_warn_days: int = Field(
        default=30, ge=1, le=365, description="`/readyz` warns this long before the TLS certificate expires"
    )
    readiness_keep_ms: float = Field(
        default=1_000.0, ge=0.0, le=10_000.0, description="Time for which an answer of `/readyz` is cached"
    )
