"""Answers of `/healthz` and `/readyz`: stable codes for machines, sentences for people."""

import enum
from typing import Literal

from pydantic import AwareDatetime, Field

from service.core.schemas.base import Answer


class ReadinessCode(enum.StrEnum):
    """Stable codes of what prevents sessions, now or soon."""

    AUDIT_TROUBLE = "audit_trouble"
    CAMERA_LATENCY = "camera_latency"
    CAMERA_RUNTIME_MISSING = "camera_runtime_missing"
    CERTIFICATE_ENDED = "certificate_ended"
    CERTIFICATE_ENDS_SOON = "certificate_ends_soon"
    CERTIFICATE_UNREADABLE = "certificate_unreadable"
    CLOCK_BEHIND = "clock_behind"
    DATABASE_UNWRITABLE = "database_unwritable"
    DISK_LOW = "disk_low"
    ENGINE_MISSING = "engine_missing"
    NOT_KNOWN = "not_known"
    QA_OVERDUE = "qa_overdue"
    RECORDINGS_MISSING = "recordings_missing"
    SERVICE_STOPPING = "service_stopping"
    THREAD_ENDED = "thread_ended"


class ReadinessReason(Answer):
    """One problem or warning."""

    code: ReadinessCode = Field(examples=[ReadinessCode.DISK_LOW])
    detail: str = Field(examples=["120 MiB of disk space are free, 200 MiB are needed"])


class Readiness(Answer):
    """Whether a session can run, and what prevents it."""

    is_ready: bool
    not_ready: list[str] = Field(description="The sentences of all reasons")
    reasons: list[ReadinessReason] = Field(description="Problems that prevent a session")
    warnings: list[ReadinessReason] = Field(description="Warnings that do not prevent a session")
    checked_at: AwareDatetime = Field(description="Time of the check; at most a few seconds ago")


class Health(Answer):
    """Liveness of the process; public, so it contains no details."""

    status: Literal["ok"]
