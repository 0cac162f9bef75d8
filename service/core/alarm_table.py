"""All alarms in one table: code, priority, text, what begins and ends each, and why it has that priority.

The priorities are those of IEC 60601-1-8: what may happen if no person reacts, and how soon (docs/adr/0028).

An alarm belongs to a session. Faults are alarms whenever they are latched. A hold is an alarm only while the gate is
armed, and only where it is no part of gating: `NOT_ALARMS` lists the reasons that are none. The row of a reason
(`engine.core.gate_state`) names its group.

One sentence for each hold reason, as the page shows it: from the page's English language file.
"""

import enum
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources

from engine.core.gate_state import AlarmGroup, HoldReason

_LANGUAGE = resources.files("service") / "web" / "dashboard" / "lang" / "en.json"
PERMIT_WITHOUT_BEAM = "permit_without_beam"
AUDIT_TROUBLE = "audit_trouble"
THREAD_ENDED = "thread_ended"
LOOK_DELAY_S = 2.0
"""Of holds that a person has to look into: a cough or a hand clears sooner."""
SIGHT_DELAY_S = 5.0
"""Of holds that mostly clear by themselves."""
_FAULT_ENDS = "the acknowledgement; if the cause persists, another alarm begins"
_HOLD_ENDS = "the gate does not hold for it for 1 s, or is disarmed"


def _texts() -> dict[HoldReason, str]:
    """Return the sentence of each reason; a reason that has none yet is called by its code."""
    words = json.loads(_LANGUAGE.read_text(encoding="utf-8"))
    return {reason: words.get(f"hold.{reason.value}.what", reason.value.replace("_", " ")) for reason in HoldReason}


HOLD_TEXTS: dict[HoldReason, str] = _texts()


def hold_text(reason: HoldReason | None) -> str | None:
    """Return the sentence of a reason; None for None."""
    return None if reason is None else HOLD_TEXTS[reason]


class AlarmPriority(enum.StrEnum):
    """Priorities of IEC 60601-1-8, the most urgent first."""

    HIGH = "high"
    MEDIUM = "medium"
    LOW = "low"

    @property
    def rank(self) -> int:
        """Place in the order of urgency: 0 for high."""
        return list(AlarmPriority).index(self)


class AlarmScope(enum.StrEnum):
    """When a condition is an alarm."""

    FAULT = "latched fault"
    ARMED = "armed"
    SESSION = "session runs"


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmRule:
    """One alarm.

    Attributes
    ----------
    code
        That of the hold reason, or one of the service's own.
    text
        Sentence for the operator.
    why
        Why it has this priority.
    ends
        What clears it.
    scope
        When the condition is an alarm.
    delay_s
        Time for which the condition lasts before the alarm begins [s].
    """

    code: str
    priority: AlarmPriority
    text: str
    why: str
    ends: str
    scope: AlarmScope
    delay_s: float = 0.0

    @property
    def latches(self) -> bool:
        """Whether it lasts until a named person acknowledges it, though its cause is gone."""
        return self.scope is AlarmScope.FAULT


@dataclass(frozen=True, slots=True)
class _Group:
    """Priority of a group's alarms, why, and how long a hold lasts before its alarm begins [s]."""

    priority: AlarmPriority
    why: str
    delay_s: float = 0.0


_P, _A = AlarmPriority, AlarmGroup
_GROUPS: Mapping[AlarmGroup, _Group] = {
    _A.BEAM_UNKNOWN: _Group(
        _P.HIGH, "the beam is on without a permit, or the line was not read back as off: a person has to see that it is"
    ),
    _A.STOPPED: _Group(_P.MEDIUM, "the beam is held; the treatment does not go on until a person has found the cause"),
    _A.PATIENT: _Group(
        _P.MEDIUM,
        "the beam is held; the patient or what lies on them has to be looked at before the gate goes on",
        LOOK_DELAY_S,
    ),
    _A.OPERATOR: _Group(_P.MEDIUM, "the beam is held; a person has to answer for the armed gate"),
    _A.SIGHT: _Group(_P.LOW, "the beam is held; it goes on by itself as soon as the measurement does", SIGHT_DELAY_S),
    _A.BREATHING: _Group(
        _P.LOW,
        "the beam is held for breathing that has ceased, or that is irregular where the site chose so; it goes on by "
        "itself with regular breathing",
        SIGHT_DELAY_S,
    ),
    _A.SET_UP: _Group(
        _P.LOW, "the beam is held until a person sets the session up again; nothing changes meanwhile", SIGHT_DELAY_S
    ),
}
_NO_ALARM: Mapping[AlarmGroup, str] = {
    _A.IDLE: "no treatment is in progress",
    _A.GATING: "gating as prescribed",
    _A.BREATHES: "gating: the patient's breathing decides",
    _A.BY_HAND: "a person holds, and is shown by name",
    _A.END: "the regular end of a recording",
    _A.STOP: "a person or the service stops the session",
}


def _rules() -> list[AlarmRule]:
    """Return the alarms of hold reasons, the most urgent group first."""
    return [
        AlarmRule(
            code=reason.value,
            priority=group.priority,
            text=HOLD_TEXTS[reason],
            why=group.why,
            ends=_FAULT_ENDS if reason.is_fault else _HOLD_ENDS,
            scope=AlarmScope.FAULT if reason.is_fault else AlarmScope.ARMED,
            delay_s=group.delay_s,
        )
        for name, group in _GROUPS.items()
        for reason in HoldReason
        if reason.row.alarm is name
    ]


ALARM_RULES: tuple[AlarmRule, ...] = (
    *_rules(),
    AlarmRule(
        code=PERMIT_WITHOUT_BEAM,
        priority=_P.LOW,
        text="The beam is permitted, and the accelerator delivers none",
        why="no beam is delivered; the accelerator may be waiting for a person, or the permit does not reach it",
        ends="beam on, or the gate is disarmed",
        scope=AlarmScope.ARMED,
    ),
    AlarmRule(
        code=AUDIT_TROUBLE,
        priority=_P.LOW,
        text="The audit log is not supervised as it should be",
        why="the gate's decisions are recorded; their protection against a change has a gap",
        ends="the anchors, the clock or the log file work again",
        scope=AlarmScope.SESSION,
    ),
    AlarmRule(
        code=THREAD_ENDED,
        priority=_P.LOW,
        text="A background task of the service has ended",
        why="the gate decides without it; a check beside the gate, such as that of the log-ins, may be missing",
        ends="the restart of the service",
        scope=AlarmScope.SESSION,
    ),
)
"""Every alarm, the most urgent first."""

ALARMS: Mapping[str, AlarmRule] = {rule.code: rule for rule in ALARM_RULES}

NOT_ALARMS: Mapping[HoldReason, str] = {
    reason: _NO_ALARM[reason.row.alarm] for reason in HoldReason if reason.row.alarm not in _GROUPS
}
"""Hold reasons that are no alarm, and why."""
