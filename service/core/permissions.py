"""Permissions and the roles that grant them; a person may have several roles.

The administrator role does not include arming. An administrator can grant that role to their own account, since some
account must be able to grant roles; the audit log records it.
"""

from collections.abc import Iterable, Mapping
from enum import StrEnum


class Permission(StrEnum):
    """One thing that may be done; a request needs exactly one."""

    SESSIONS_READ = "sessions.read"
    SESSIONS_RUN = "sessions.run"
    GATE_REFERENCE = "gate.reference"
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
    COACH_WATCH = "coach.watch"
    COACH_MANAGE = "coach.manage"


MEANING: Mapping[Permission, str] = {
    Permission.SESSIONS_READ: "read sessions, plans, samples, the live stream, pictures, "
    "models, devices, recordings and interlocks",
    Permission.SESSIONS_RUN: "create and start sessions",
    Permission.GATE_REFERENCE: "set the reference, sign the patient's position, and countersign; for people only",
    Permission.GATE_ARM: "arm, release a hold, correct the baseline: everything that can lead to beam on; "
    "people also answer for an armed gate by their presence",
    Permission.GATE_HOLD: "hold, disarm, stop, cancel a QA run: everything that takes the beam off",
    Permission.GATE_ACKNOWLEDGE: "acknowledge a latched fault and alarms; for people only",
    Permission.MODELS_WRITE: "train a new model, activate a stored one",
    Permission.PLANS_WRITE: "import RT Plans",
    Permission.CALIBRATIONS_READ: "read calibrations",
    Permission.CALIBRATIONS_WRITE: "upload calibrations",
    Permission.QA_READ: "read QA runs, reports and trends",
    Permission.QA_RUN: "start QA runs, which permit the beam outside of gating; for people only",
    Permission.QA_BASELINE: "set the expected camera position",
    Permission.AUDIT_READ: "read and verify the audit log",
    Permission.USERS_MANAGE: "create and change people and API keys; for people only",
    Permission.METRICS_READ: "read metrics",
    Permission.COACH_WATCH: "watch the patient screen's stream: no name, no millimetres; all that a paired screen may",
    Permission.COACH_MANAGE: "pair and end patient screens, set band, display and practice; for people only",
}


class Role(StrEnum):
    """A person's role at the site; it grants the permissions in ROLE_PERMISSIONS."""

    VIEWER = "viewer"
    THERAPIST = "therapist"
    PHYSICIST = "physicist"
    ADMIN = "admin"


_SEES = frozenset({Permission.SESSIONS_READ, Permission.CALIBRATIONS_READ, Permission.QA_READ, Permission.COACH_WATCH})
_TREATS = _SEES | {
    Permission.SESSIONS_RUN,
    Permission.GATE_REFERENCE,
    Permission.GATE_ARM,
    Permission.GATE_HOLD,
    Permission.GATE_ACKNOWLEDGE,
    Permission.MODELS_WRITE,
    Permission.AUDIT_READ,
    Permission.COACH_MANAGE,
}

ROLE_PERMISSIONS: Mapping[Role, frozenset[Permission]] = {
    Role.VIEWER: _SEES,
    Role.THERAPIST: _TREATS,
    Role.PHYSICIST: _TREATS
    | {
        Permission.CALIBRATIONS_WRITE,
        Permission.PLANS_WRITE,
        Permission.QA_RUN,
        Permission.QA_BASELINE,
        Permission.AUDIT_READ,
        Permission.METRICS_READ,
    },
    Role.ADMIN: _SEES | {Permission.GATE_HOLD, Permission.AUDIT_READ, Permission.USERS_MANAGE, Permission.METRICS_READ},
}

KEY_PERMISSIONS: frozenset[Permission] = frozenset(Permission) - {
    Permission.GATE_REFERENCE,
    Permission.GATE_ACKNOWLEDGE,
    Permission.QA_RUN,
    Permission.USERS_MANAGE,
    Permission.COACH_MANAGE,
}
"""Permissions that a machine may have: the reference, acknowledging a fault, starting QA, managing users and pairing
patient screens are for people only."""


def permissions_of(roles: Iterable[Role]) -> frozenset[Permission]:
    """Unite what the roles may do."""
    return frozenset().union(*(ROLE_PERMISSIONS[role] for role in roles))
