"""Mapping of actions to DICOM audit event codes (PS3.16, CID 400 and 401), as used by FHIR and ATNA.

These codes are coarse, so every event also carries the action itself in a private code system.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

ActionLetter = Literal["C", "R", "U", "D", "E"]


class Code(NamedTuple):
    """A code of DICOM's own terminology (DCM)."""

    value: str
    meaning: str


APPLICATION = Code("110100", "Application Activity")
LOG_USED = Code("110101", "Audit Log Used")
EXPORT = Code("110106", "Export")
IMPORT = Code("110107", "Import")
PROCEDURE = Code("110111", "Procedure Record")
ALERT = Code("110113", "Security Alert")
AUTHENTICATION = Code("110114", "User Authentication")

STARTED = Code("110120", "Application Start")
STOPPED = Code("110121", "Application Stop")
LOGIN = Code("110122", "Login")
LOGOUT = Code("110123", "Logout")
EMERGENCY = Code("110127", "Emergency Override Started")
HARDWARE = Code("110130", "Hardware Configuration")
SOFTWARE = Code("110131", "Software Configuration")
RESTRICTED = Code("110132", "Use of Restricted Function")
RECORDING_STOPPED = Code("110133", "Audit Recording Stopped")
RECORDING_STARTED = Code("110134", "Audit Recording Started")
OBJECT_CHANGED = Code("110135", "Object Security Attributes Changed")
USER_CHANGED = Code("110137", "User Security Attributes Changed")

APPLICATION_ROLE = Code("110150", "Application")


@dataclass(frozen=True, slots=True, kw_only=True)
class Meaning:
    """Event and type codes of an action, and its CRUDE letter."""

    event: Code
    type: Code | None = None
    letter: ActionLetter = "E"


MEANINGS: dict[str, Meaning] = {
    "service.start": Meaning(event=APPLICATION, type=STARTED),
    "service.stop": Meaning(event=APPLICATION, type=STOPPED),
    "settings.changed": Meaning(event=ALERT, type=SOFTWARE, letter="U"),
    "clock.changed": Meaning(event=ALERT, type=HARDWARE, letter="U"),
    "audit.broken": Meaning(event=ALERT, type=OBJECT_CHANGED),
    "audit.anchors_failed": Meaning(event=ALERT, type=RECORDING_STOPPED),
    "audit.anchors_resumed": Meaning(event=ALERT, type=RECORDING_STARTED),
    "audit.forwarding_failed": Meaning(event=ALERT, type=RECORDING_STOPPED),
    "audit.forwarding_resumed": Meaning(event=ALERT, type=RECORDING_STARTED),
    "audit.export": Meaning(event=LOG_USED, letter="R"),
    "access.refused": Meaning(event=ALERT, type=RESTRICTED),
    "user.login": Meaning(event=AUTHENTICATION, type=LOGIN),
    "user.logout": Meaning(event=AUTHENTICATION, type=LOGOUT),
    "user.end_login": Meaning(event=AUTHENTICATION, type=LOGOUT),
    "user.logout_other": Meaning(event=AUTHENTICATION, type=LOGOUT),
    "user.break_glass": Meaning(event=ALERT, type=EMERGENCY),
    "user.create": Meaning(event=ALERT, type=USER_CHANGED, letter="C"),
    "screen.pair": Meaning(event=ALERT, type=USER_CHANGED, letter="C"),
    "screen.end": Meaning(event=ALERT, type=USER_CHANGED, letter="D"),
    "key.create": Meaning(event=ALERT, type=USER_CHANGED, letter="C"),
    "key.revoke": Meaning(event=ALERT, type=USER_CHANGED, letter="D"),
    "backup.made": Meaning(event=EXPORT, letter="R"),
    "backup.restored": Meaning(event=IMPORT, letter="C"),
    "samples.export": Meaning(event=EXPORT, letter="R"),
    "samples.removed": Meaning(event=PROCEDURE, letter="D"),
    "raw.removed": Meaning(event=PROCEDURE, letter="D"),
    "tape.removed": Meaning(event=PROCEDURE, letter="D"),
    "qa.export": Meaning(event=EXPORT, letter="R"),
    "qa.baseline": Meaning(event=PROCEDURE, letter="C"),
    "plan.import": Meaning(event=IMPORT, letter="C"),
    "calibration.upload": Meaning(event=IMPORT, letter="C"),
    "session.create": Meaning(event=PROCEDURE, letter="C"),
    "session.close": Meaning(event=PROCEDURE, letter="U"),
}
"""Actions with their own codes; the others use the codes of their first word."""

FAMILIES: dict[str, Meaning] = {
    "user": Meaning(event=ALERT, type=USER_CHANGED, letter="U"),
    "key": Meaning(event=ALERT, type=USER_CHANGED, letter="U"),
    "screen": Meaning(event=ALERT, type=USER_CHANGED, letter="U"),
    "coaching": Meaning(event=PROCEDURE, letter="U"),
    "access": Meaning(event=ALERT, type=RESTRICTED),
    "audit": Meaning(event=LOG_USED, letter="R"),
    "backup": Meaning(event=APPLICATION),
    "database": Meaning(event=APPLICATION, letter="U"),
    "samples": Meaning(event=PROCEDURE, letter="U"),
    "session": Meaning(event=PROCEDURE),
    "gate": Meaning(event=PROCEDURE),
    "model": Meaning(event=PROCEDURE, letter="U"),
    "qa": Meaning(event=PROCEDURE),
    "calibration": Meaning(event=PROCEDURE, letter="U"),
}

OUTCOMES: dict[str, Literal["0", "4", "8", "12"]] = {"done": "0", "requested": "0", "refused": "4", "failed": "8"}
"""Success, minor, serious and major failure (RFC 3881, 5.1.4)."""
MAJOR = frozenset({"audit.broken"})
"""Actions graded as major failures."""


def meaning_of(action: str) -> Meaning:
    """Return the codes of an action; an unknown one is an application activity."""
    found = MEANINGS.get(action) or FAMILIES.get(action.partition(".")[0])
    return found or Meaning(event=APPLICATION)


def outcome_of(action: str, outcome: str) -> Literal["0", "4", "8", "12"]:
    """Return the RFC 3881 outcome code; an unknown outcome is a serious failure."""
    return "12" if action in MAJOR else OUTCOMES.get(outcome, "8")
