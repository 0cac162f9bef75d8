"""Filters of the list calls; None does not filter. `since` is inclusive, `until` exclusive."""

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionFilter:
    """Filter of sessions; `since` and `until` apply to the time of creation."""

    status: str | None = None
    patient_reference: str | None = None
    plan_id: str | None = None
    since: datetime | None = None
    until: datetime | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditFilter:
    """Filter of audit rows."""

    action: str | None = None
    actor: str | None = None
    outcome: str | None = None
    since: datetime | None = None
    until: datetime | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TransitionFilter:
    """Filter of gate transitions."""

    to_state: str | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class QaRunFilter:
    """Filter of QA runs."""

    kind: str | None = None
    verdict: str | None = None


ALL_SESSIONS, ALL_ROWS, ALL_TRANSITIONS, ALL_RUNS = SessionFilter(), AuditFilter(), TransitionFilter(), QaRunFilter()
