"""What `/healthz` and `/readyz` say: stable codes for machines, sentences for people."""

import enum
from typing import Literal

from pydantic import AwareDatetime, Field

from service.schema_base import Answer


class ReadinessCode(enum.StrEnum):
    """Why no session could run now, or what will keep one from running soon; stable."""

    AUDIT_TROUBLE = "audit_trouble"
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
    """One thing that is missing, or will be."""

    code: ReadinessCode = Field(examples=[ReadinessCode.DISK_LOW])
    detail: str = Field(examples=["only 120 MiB of disk are free, 200 are needed"])


class Readiness(Answer):
    """Whether a session could run, and what is missing."""

    is_ready: bool
    not_ready: list[str] = Field(description="The reasons' sentences")
    reasons: list[ReadinessReason] = Field(description="What keeps a session from running")
    warnings: list[ReadinessReason] = Field(description="What keeps none from running yet")
    checked_at: AwareDatetime = Field(description="When it was looked; at most some seconds ago")


class Health(Answer):
    """The process answers; to anybody, so that it says no more."""

    status: Literal["ok"]
