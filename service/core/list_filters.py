"""Filters of the list calls; None does not filter. `since` is inclusive, `until` exclusive."""

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionFilter:
    """Filter of sessions; `since` and `until` apply to the time of creation.

    `search` is part of the patient's reference, the plan's id or the fraction's.
    """

    status: str | None = None
    patient_reference: str | None = None
    plan_id: str | None = None
    search: str | None = None
    since: datetime | None = None
    until: datetime | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanFilter:
    """Filter of plans; `search` is part of the patient's reference or of the label."""

    patient_reference: str | None = None
    label: str | None = None
    search: str | None = None


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


ALL_SESSIONS, ALL_PLANS, ALL_ROWS = SessionFilter(), PlanFilter(), AuditFilter()
ALL_TRANSITIONS, ALL_RUNS = TransitionFilter(), QaRunFilter()
