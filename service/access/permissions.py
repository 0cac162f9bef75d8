"""What may be done, and by whom: few permissions, four roles. A person may have several roles.

Whoever administers does not arm by that: who makes people and keys treats under the same name only where they have a
role for it. That they gave it to themselves is not prevented, for somebody must be able to; it is in the audit.
"""

from collections.abc import Iterable, Mapping
from enum import StrEnum


class Permission(StrEnum):
    """One thing that may be done; a request needs exactly one."""

    SESSIONS_READ = "sessions.read"
    SESSIONS_RUN = "sessions.run"
    GATE_ARM = "gate.arm"
    GATE_HOLD = "gate.hold"
    GATE_ACKNOWLEDGE = "gate.acknowledge"
    MODELS_WRITE = "models.write"
    PLANS_WRITE = "plans.write"
    CALIBRATIONS_READ = "calibrations.read"
    CALIBRATIONS_WRITE = "calibrations.write"
    QA_READ = "qa.read"
    QA_RUN = "qa.run"
    QA_BASELINE = "qa.baseline"
    AUDIT_READ = "audit.read"
    USERS_MANAGE = "users.manage"
    METRICS_READ = "metrics.read"


MEANING: Mapping[Permission, str] = {
    Permission.SESSIONS_READ: "see sessions, plans, samples, the live stream, pictures, models, devices and interlocks",
    Permission.SESSIONS_RUN: "create and start sessions, set the reference, say that the page is looked at",
    Permission.GATE_ARM: "arm, release a hold, correct the baseline: what lets the gate decide",
    Permission.GATE_HOLD: "hold, disarm, stop: what takes the beam away",
    Permission.GATE_ACKNOWLEDGE: "acknowledge a latched fault; for people only",
    Permission.MODELS_WRITE: "learn a model anew, let one take over",
    Permission.PLANS_WRITE: "import RT Plans",
    Permission.CALIBRATIONS_READ: "see calibrations",
    Permission.CALIBRATIONS_WRITE: "upload calibrations",
    Permission.QA_READ: "see QA runs, reports and trends",
    Permission.QA_RUN: "start and cancel QA runs, which permit the beam",
    Permission.QA_BASELINE: "fix what the camera's place should read",
    Permission.AUDIT_READ: "read and verify the audit log",
    Permission.USERS_MANAGE: "make and change people and API keys; for people only",
    Permission.METRICS_READ: "read metrics",
}


class Role(StrEnum):
    """What a person is at the site."""

    VIEWER = "viewer"
    THERAPIST = "therapist"
    PHYSICIST = "physicist"
    ADMIN = "admin"


_SEES = frozenset({Permission.SESSIONS_READ, Permission.CALIBRATIONS_READ, Permission.QA_READ})
_TREATS = _SEES | {
    Permission.SESSIONS_RUN,
    Permission.GATE_ARM,
    Permission.GATE_HOLD,
    Permission.GATE_ACKNOWLEDGE,
    Permission.MODELS_WRITE,
    Permission.QA_RUN,
    Permission.AUDIT_READ,
}

ROLE_PERMISSIONS: Mapping[Role, frozenset[Permission]] = {
    Role.VIEWER: _SEES,
    Role.THERAPIST: _TREATS,
    Role.PHYSICIST: _TREATS
    | {
        Permission.CALIBRATIONS_WRITE,
        Permission.PLANS_WRITE,
        Permission.QA_BASELINE,
        Permission.AUDIT_READ,
        Permission.METRICS_READ,
    },
    Role.ADMIN: _SEES | {Permission.GATE_HOLD, Permission.AUDIT_READ, Permission.USERS_MANAGE, Permission.METRICS_READ},
}

KEY_PERMISSIONS: frozenset[Permission] = frozenset(Permission) - {
    Permission.GATE_ACKNOWLEDGE,
    Permission.USERS_MANAGE,
}
"""What a machine may have: a fault is acknowledged by a person who has looked, and people are made by people."""


def permissions_of(roles: Iterable[Role]) -> frozenset[Permission]:
    """Unite what the roles may do."""
    return frozenset().union(*(ROLE_PERMISSIONS[role] for role in roles))
