"""Base classes and shared types of the schemas: strict requests, answers, printable names, numbers, problems.

Problems are those of RFC 9457. A number that could not be measured leaves the service as None, never as NaN, infinity
or a magic number.

Answers of `/healthz` and `/readyz`: stable codes for machines, sentences for people.
"""

import enum
import math
from typing import Annotated, Literal

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, StringConstraints
from pydantic_core import PydanticCustomError

from service.core.identity import identity_text, is_of_one_script
from service.core.schemas.sentences import SentenceParts, Text

Name = Annotated[str, StringConstraints(min_length=1, max_length=80), AfterValidator(identity_text)]
Identifier = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]


def broken(field: str, value: object, bound: str) -> PydanticCustomError:
    """Return the validation error of a rule that spans several fields.

    `service.web.problems.table` reads field, value and bound from its context.
    """
    context = {"field": field, "value": value if isinstance(value, str) else repr(value), "bound": bound}
    return PydanticCustomError("inconsistent", "{field} must be {bound}", context)


def _printable(text: str) -> str:
    if not text.isprintable() or not text.strip():
        msg = "must be printable characters, not only spaces"
        raise ValueError(msg)
    return text


def _of_one_script(name: str) -> str:
    if not is_of_one_script(name):
        msg = "must be letters of one script, so that none passes for a letter of another"
        raise ValueError(msg)
    return name


def printable_or_empty(text: str) -> str:
    """Return the text; raise ValueError for what is not printable."""
    return _printable(text) if text else text


SourceText = Annotated[str, StringConstraints(min_length=1, max_length=1024), AfterValidator(_printable)]
Operator = Annotated[
    Name,
    AfterValidator(_of_one_script),
    Field(
        description="The responsible person. May be left out by a person who is logged in; an API key"
        " sends the name of the person it acts for",
        examples=["A. Therapist"],
    ),
]


class Request(BaseModel):
    """Base of everything read from a client."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Answer(BaseModel):
    """Base of every answer."""

    model_config = ConfigDict(frozen=True)


def finite_or_none(value: float | None) -> float | None:
    """Return a measured value as a float; None where it is missing, NaN or infinite."""
    return None if value is None or not math.isfinite(value) else float(value)


def rounded_or_none(value: float | None, digits: int = 4) -> float | None:
    """Return a measured value, rounded to so many decimals; None where it is missing, NaN or infinite."""
    finite = finite_or_none(value)
    return None if finite is None else round(finite, digits)


class BrokenBound(Answer):
    """One value of a request that is outside its bound."""

    field: str = Field(examples=["window.lower_mm"])
    value: str = Field(examples=["-400.0"])
    bound: str = Field(examples=["at least -100"])


class Problem(Answer):
    """RFC 9457 problem with a stable code; with field, value and bound if a value broke a bound."""

    type: str = Field(examples=["urn:tidegate:problem:invalid_value"])
    title: str
    status: int
    detail: Text
    code: str = Field(examples=["invalid_value"])
    field: str | None = Field(default=None, examples=["window.lower_mm"])
    value: str | None = Field(default=None, examples=["-400.0"])
    bound: str | None = Field(default=None, examples=["at least -100"])
    remedy: str | None = Field(default=None, description="What to do, or to call next")
    sentences: list[SentenceParts] | None = Field(
        default=None, description="What the sentences with values in `detail` were made from"
    )
    errors: list[BrokenBound] | None = Field(
        default=None, description="All values outside their bounds, starting with the one above; at most 20"
    )


class ReadinessCode(enum.StrEnum):
    """Stable codes of what prevents sessions, now or soon."""

    ANCHORS_INSIDE = "anchors_inside"
    AUDIT_TROUBLE = "audit_trouble"
    CAMERA_LATENCY = "camera_latency"
    CAMERA_RUNTIME_MISSING = "camera_runtime_missing"
    CERTIFICATE_ENDED = "certificate_ended"
    CERTIFICATE_ENDS_SOON = "certificate_ends_soon"
    CERTIFICATE_UNREADABLE = "certificate_unreadable"
    CLOCK_BEHIND = "clock_behind"
    CLOCK_DOUBTED = "clock_doubted"
    DATABASE_LOG_LARGE = "database_log_large"
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


class MachineSetting(Answer):
    """One setting in force."""

    name: str = Field(examples=["TIDEGATE_MAX_FRAME_AGE_MS"])
    section: str = Field(description="Its section in the site's file")
    value: str = Field(description="As JSON; a secret is replaced by a fixed text")
    source: str = Field(description="`default`, `environment`, `command line`, or the path of the site's file")


class Machine(Answer):
    """What runs on the machine of the service."""

    version: str
    method: int = Field(description="Number of the method that measures; sessions of another one replay differently")
    python: str
    system: str = Field(description="Operating system, its release, and the processor's kind")
    started_at: AwareDatetime = Field(description="When the service started")
    now: AwareDatetime = Field(description="The service's clock")
    disk_free_mb: int = Field(description="Free space on the disk of the data folder")
    disk_total_mb: int
    backup_at: AwareDatetime | None = Field(description="When `tidegate backup` last made one; null if never")
    certificate_ends_at: AwareDatetime | None = Field(description="null where the service does not terminate TLS")
    plug_ins: list[str] = Field(description="Cameras and beam lines of other distributions: version, name, SHA-256")
    readiness: Readiness
    settings: list[MachineSetting] = Field(description="Section by section, each in alphabetical order")


class Health(Answer):
    """Liveness of the process; public, so it contains no details."""

    status: Literal["ok"]
