"""All alarms in one table: code, priority, text, what begins and ends each, and why it has that priority.

The priorities are those of IEC 60601-1-8: what may happen if no person reacts, and how soon (docs/adr/0028).

An alarm belongs to a session. Faults are alarms whenever they are latched. A hold is an alarm only while the gate is
armed, and only where it is no part of gating: `NOT_ALARMS` lists the hold reasons that are none, each with its reason.
"""

import enum
from collections.abc import Mapping
from dataclasses import dataclass

from engine.core.gate_state import HoldReason
from service.core.hold_texts import HOLD_TEXTS


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


PERMIT_WITHOUT_BEAM = "permit_without_beam"
AUDIT_TROUBLE = "audit_trouble"
THREAD_ENDED = "thread_ended"

LOOK_DELAY_S = 2.0
"""Of holds that a person has to look into: a cough or a hand clears sooner."""
SIGHT_DELAY_S = 5.0
"""Of holds that mostly clear by themselves."""

_P, _R = AlarmPriority, HoldReason
_FAULT_ENDS = "the acknowledgement; if the cause persists, another alarm begins"
_HOLD_ENDS = "the gate does not hold for it for 1 s, or is disarmed"
_BEAM_UNKNOWN = "the beam is on without a permit, or the line was not read back as off: a person has to see that it is"
_STOPPED = "the beam is held; the treatment does not go on until a person has found the cause"
_PATIENT = "the beam is held; the patient or what lies on them has to be looked at before the gate goes on"
_SIGHT = "the beam is held; it goes on by itself as soon as the measurement does"


def _faults(priority: AlarmPriority, why: str, *reasons: HoldReason) -> list[AlarmRule]:
    return [
        AlarmRule(
            code=reason.value,
            priority=priority,
            text=HOLD_TEXTS[reason],
            why=why,
            ends=_FAULT_ENDS,
            scope=AlarmScope.FAULT,
        )
        for reason in reasons
    ]


def _holds(priority: AlarmPriority, why: str, delay_s: float, *reasons: HoldReason) -> list[AlarmRule]:
    return [
        AlarmRule(
            code=reason.value,
            priority=priority,
            text=HOLD_TEXTS[reason],
            why=why,
            ends=_HOLD_ENDS,
            scope=AlarmScope.ARMED,
            delay_s=delay_s,
        )
        for reason in reasons
    ]


ALARM_RULES: tuple[AlarmRule, ...] = (
    *_faults(
        _P.HIGH,
        _BEAM_UNKNOWN,
        _R.BEAM_WITHOUT_PERMIT,
        _R.BEAM_LINE_MISMATCH,
        _R.BEAM_LINE_FAILED,
        _R.WATCHDOG,
        _R.ENGINE_FAILED,
        _R.UNKNOWN,
    ),
    *_faults(
        _P.MEDIUM,
        _STOPPED,
        _R.SERVICE_SILENT,
        _R.SOURCE_LOST,
        _R.FRAME_TIMEOUT,
        _R.FRAME_STALE,
        _R.CLOCK_BACKWARDS,
        _R.CLOCK_JUMPED,
        _R.LATENCY_HIGH,
        _R.VALUE_INVALID,
        _R.AUDIT_BEHIND,
        _R.RECORDER_BEHIND,
        _R.DISK_LOW,
    ),
    *_holds(
        _P.MEDIUM,
        _PATIENT,
        LOOK_DELAY_S,
        _R.PATIENT_SHIFTED,
        _R.BASELINE_DRIFTED,
        _R.SURFACE_CHANGED,
        _R.LAYOUT_CHANGED,
        _R.CAMERA_MOVED,
    ),
    *_holds(_P.MEDIUM, "the beam is held; a person has to answer for the armed gate", 0.0, _R.OPERATOR_LOST),
    *_holds(
        _P.LOW,
        _SIGHT,
        SIGHT_DELAY_S,
        _R.MARKER_LOST,
        _R.COVERAGE_LOW,
        _R.RESIDUAL_HIGH,
        _R.CHECK_MISSING,
        _R.JUMP,
        _R.FRAME_MISSING,
        _R.FRAME_LATE,
        _R.FRAME_FROZEN,
        _R.FRAME_RATE_LOW,
        _R.BEAM_ON_LIMIT,
    ),
    *_holds(
        _P.LOW,
        "the beam is held for breathing that has ceased, or that is irregular where the site chose so; it goes on by "
        "itself with regular breathing",
        SIGHT_DELAY_S,
        _R.BREATHING_IRREGULAR,
    ),
    *_holds(
        _P.LOW,
        "the beam is held until a person sets the session up again; nothing changes meanwhile",
        SIGHT_DELAY_S,
        _R.MODEL_OLD,
        _R.MODEL_MISSING,
        _R.TRAINING,
        _R.REFERENCE_MISSING,
        _R.POSITION_UNCHECKED,
        _R.CALIBRATION_MISSING,
        _R.HEAD_DIRECTION_MISSING,
    ),
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

_GATING = "gating as prescribed"
_PATIENT_BREATHES = "gating: the patient's breathing decides"

NOT_ALARMS: Mapping[HoldReason, str] = {
    _R.DISARMED: "no treatment is in progress",
    _R.OUTSIDE_WINDOW: _GATING,
    _R.DWELL: _GATING,
    _R.SHORTEST_OFF: _GATING,
    _R.CYCLE_LIMIT: _GATING,
    _R.PHASE_UNKNOWN: _PATIENT_BREATHES,
    _R.RANGE_UNKNOWN: _PATIENT_BREATHES,
    _R.BREATH_HOLD_AWAITED: _PATIENT_BREATHES,
    _R.BREATH_HOLD_SETTLING: _PATIENT_BREATHES,
    _R.BREATH_HOLD_DRIFTED: _PATIENT_BREATHES,
    _R.BREATH_HOLD_OVER: _PATIENT_BREATHES,
    _R.OPERATOR_HOLD: "a person holds, and is shown by name",
    _R.SOURCE_ENDED: "the regular end of a recording",
    _R.ENGINE_STOPPED: "a person or the service stops the session",
}
"""Hold reasons that are no alarm, and why."""
