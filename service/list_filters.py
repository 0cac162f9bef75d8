"""What of a list is asked for; None asks for all. Times are from `since` on, and before `until`."""

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionFilter:
    """Which sessions, by when they were created."""

    status: str | None = None
    patient_reference: str | None = None
    plan_id: str | None = None
    since: datetime | None = None
    until: datetime | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditFilter:
    """Which rows of the audit."""

    action: str | None = None
    actor: str | None = None
    outcome: str | None = None
    since: datetime | None = None
    until: datetime | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TransitionFilter:
    """Which transitions of a gate."""

    to_state: str | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class QaRunFilter:
    """Which QA runs."""

    kind: str | None = None
    verdict: str | None = None


ALL_SESSIONS, ALL_ROWS, ALL_TRANSITIONS, ALL_RUNS = SessionFilter(), AuditFilter(), TransitionFilter(), QaRunFilter()
