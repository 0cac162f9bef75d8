"""What a site sets about how its service is watched: the log's form and level, and when to warn of a certificate."""

from typing import Literal

from pydantic import Field
from pydantic_settings import BaseSettings

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]


class MonitoringSettings(BaseSettings):
    """Log and readiness; see docs/monitoring.md."""

    log_format: LogFormat = Field(
        default="text", description="text for a person at a terminal, json for a collector: one object a line"
    )
    log_level: LogLevel = Field(
        default="warning",
        description="The least of our own that is logged; info has a line a request. Libraries log from warning on",
    )
    certificate_warn_days: int = Field(
        default=30, ge=1, le=365, description="`/readyz` warns so long before the TLS certificate ends"
    )
    readiness_keep_ms: float = Field(
        default=1_000.0, ge=0.0, le=10_000.0, description="What `/readyz` found is told again for so long"
    )
