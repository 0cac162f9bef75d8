"""The words of the gate: states, reasons to hold, and the lease that lets the beam line be on.

They stand below stages and beam lines because both speak them, and neither may import the other.
"""

import enum
from dataclasses import dataclass
from typing import Self

OWN = "own"
GATING_INTERLOCK = "AAPM TG-142: gating interlock, functional"
TIMING = "AAPM TG-142: within 100 ms of expected; AAPM TG-76: 0.5 s in all"
PATIENT_POSITION = "DICOM PS3.3 C.7.3.1.1.2: patient position"
SETUP = "AAPM TG-302: position by the surface before treatment; AAPM TG-147"
SETUP_CAMERA = "AAPM TG-147, TG-302: let a camera warm up"
TERMINATION = "IEC 60601-2-1: termination of irradiation; AAPM TG-142: gating interlock, functional"
LOCALIZATION = "AAPM TG-147: calibration of the localization system"


class GateState(enum.StrEnum):
    """Where the gate stands; only ``BEAM_ON`` ever comes with a lease."""

    DISARMED = "disarmed"
    HOLD = "hold"
    DWELL = "dwell"
    BEAM_ON = "beam_on"
    FAULT = "fault"


class AlarmGroup(enum.Enum):
    """Reasons that are the same alarm to a person, or the same reason why there is none; see the alarm table."""

    BEAM_UNKNOWN = enum.auto()
    STOPPED = enum.auto()
    PATIENT = enum.auto()
    OPERATOR = enum.auto()
    SIGHT = enum.auto()
    BREATHING = enum.auto()
    SET_UP = enum.auto()
    # No alarms.
    IDLE = enum.auto()
    GATING = enum.auto()
    BREATHES = enum.auto()
    BY_HAND = enum.auto()
    END = enum.auto()
    STOP = enum.auto()


class Guidance(enum.Enum):
    """What the patient screen shows of a frame that is held for a reason."""

    HIDDEN = enum.auto()
    """Nothing: the frame is not trusted."""
    FOLLOWED = enum.auto()
    """The breath: it decides."""
    FREE = enum.auto()
    """The breath, with no instruction: none would bring the beam."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldRow:
    """What belongs to a reason to hold.

    Attributes
    ----------
    is_fault
        Whether it latches until a named person acknowledges it; otherwise it clears by itself, after a full dwell.
    trips
        What trips the interlock, in a few words; empty for what is gating and no interlock.
    settings
        Names of the site's settings that bound it.
    source
        The guideline that demands it; ``own`` where none does.
    """

    is_fault: bool
    trips: str
    settings: tuple[str, ...]
    source: str
    alarm: AlarmGroup
    guide: Guidance


_A, _G = AlarmGroup, Guidance
_Row = tuple[str, HoldRow]


def _gating(code: str, *, alarm: AlarmGroup, guide: Guidance = Guidance.HIDDEN) -> _Row:
    return code, HoldRow(is_fault=False, trips="", settings=(), source=OWN, alarm=alarm, guide=guide)


def _hold(
    code: str, trips: str, *settings: str, alarm: AlarmGroup, source: str = OWN, guide: Guidance = Guidance.HIDDEN
) -> _Row:
    return code, HoldRow(is_fault=False, trips=trips, settings=settings, source=source, alarm=alarm, guide=guide)


def _fault(code: str, trips: str, *settings: str, alarm: AlarmGroup, source: str = OWN) -> _Row:
    hidden = Guidance.HIDDEN
    return code, HoldRow(is_fault=True, trips=trips, settings=settings, source=source, alarm=alarm, guide=hidden)


class HoldReason(enum.StrEnum):
    """Why the beam is held: one row for each reason, from which interlock table, alarms and patient screen derive.

    The value is the stable code used in files, the API and the audit. Its sentences are in the page's language files.
    """

    _value_: str
    row: HoldRow

    def __new__(cls, code: str, row: HoldRow | None = None) -> Self:
        """Make a member of its row; every member has one."""
        assert row is not None, "a code alone is looked up, not made"
        member = str.__new__(cls, code)
        member._value_ = code
        member.row = row
        return member

    # Gating: they clear by themselves, and are no interlock.
    DISARMED = _gating("disarmed", alarm=_A.IDLE, guide=_G.FOLLOWED)
    OUTSIDE_WINDOW = _gating("outside_window", alarm=_A.GATING, guide=_G.FOLLOWED)
    DWELL = _gating("dwell", alarm=_A.GATING, guide=_G.FOLLOWED)
    PHASE_UNKNOWN = _gating("phase_unknown", alarm=_A.BREATHES, guide=_G.FREE)
    RANGE_UNKNOWN = _gating("range_unknown", alarm=_A.BREATHES)
    BREATH_HOLD_AWAITED = _gating("breath_hold_awaited", alarm=_A.BREATHES, guide=_G.FOLLOWED)
    BREATH_HOLD_SETTLING = _gating("breath_hold_settling", alarm=_A.BREATHES, guide=_G.FOLLOWED)
    BREATH_HOLD_DRIFTED = _gating("breath_hold_drifted", alarm=_A.BREATHES, guide=_G.FOLLOWED)
    BREATH_HOLD_OVER = _gating("breath_hold_over", alarm=_A.BREATHES, guide=_G.FOLLOWED)
    SHORTEST_OFF = _gating("shortest_off", alarm=_A.GATING, guide=_G.FOLLOWED)
    CYCLE_LIMIT = _gating("cycle_limit", alarm=_A.GATING, guide=_G.FOLLOWED)
    # Interlocks: a hold clears by itself after a full dwell, a fault latches until a named person acknowledges it.
    FRAME_STALE = _fault(
        "frame_stale",
        "a frame much too old at its decision, or pictures repeated for more than 100 ms in a session, 50 ms in part",
        "max_silence_ms",
        alarm=_A.STOPPED,
    )
    FRAME_LATE = _hold(
        "frame_late",
        "a frame too old at its decision, delayed against the fastest one, or not known to be fresh for 0.5 s",
        "max_frame_age_ms",
        "max_lag_ms",
        alarm=_A.SIGHT,
    )
    FRAME_MISSING = _hold("frame_missing", "a frame lost or not received in time", "max_gap_ms", alarm=_A.SIGHT)
    FRAME_TIMEOUT = _fault("frame_timeout", "no frame for too long", "max_silence_ms", alarm=_A.STOPPED)
    FRAME_FROZEN = _hold("frame_frozen", "an old depth or colour picture with a new time", alarm=_A.SIGHT)
    FRAME_RATE_LOW = _hold("frame_rate_low", "too few frames within the last second", "min_fps", alarm=_A.SIGHT)
    CLOCK_BACKWARDS = _fault("clock_backwards", "time or order of frames does not increase", alarm=_A.STOPPED)
    CLOCK_JUMPED = _fault(
        "clock_jumped",
        "a step of the camera's clock against the host's, or a rate that differs by more than 200 ppm for two minutes",
        "max_clock_jump_ms",
        alarm=_A.STOPPED,
    )
    LATENCY_HIGH = _fault(
        "latency_high",
        "latency from capture to the command of the line too high",
        "max_latency_ms",
        "camera_latency_ms",
        alarm=_A.STOPPED,
        source=TIMING,
    )
    SOURCE_LOST = _fault("source_lost", "the camera is disconnected, or the recording damaged", alarm=_A.STOPPED)
    MARKER_LOST = _hold("marker_lost", "fewer than four markers found, or a colour picture too old", alarm=_A.SIGHT)
    LAYOUT_CHANGED = _hold("layout_changed", "distances between the markers changed", alarm=_A.PATIENT)
    PATIENT_SHIFTED = _hold(
        "patient_shifted",
        "the markers moved along the couch, rotated, or slide with the breath; or the surface moved as a whole",
        "max_shift_mm",
        "max_marker_travel_mm",
        "max_turn_deg",
        "max_height_mm",
        alarm=_A.PATIENT,
    )
    POSITION_UNCHECKED = _hold(
        "position_unchecked",
        "in a later fraction, the position was not compared with the plan's and signed, or the patient moved since",
        "max_position_shift_mm",
        "max_position_turn_deg",
        "max_position_shape_mm",
        alarm=_A.SET_UP,
        source=SETUP,
    )
    BASELINE_DRIFTED = _hold(
        "baseline_drifted",
        "in an amplitude window, the end of exhale drifted, or is not known after a jump or 1 s unmeasured",
        "max_baseline_drift_mm",
        alarm=_A.PATIENT,
        guide=_G.FREE,
    )
    BEAM_ON_LIMIT = _hold(
        "beam_on_limit",
        "in an amplitude or phase window, beam for too long without the signal's leaving the window",
        "max_beam_on_s",
        alarm=_A.SIGHT,
        guide=_G.FREE,
    )
    COVERAGE_LOW = _hold(
        "coverage_low",
        "too little of the region or of a gated signal visible",
        "min_valid_share",
        "min_signal_share",
        "min_wide_share",
        alarm=_A.SIGHT,
    )
    RESIDUAL_HIGH = _hold(
        "residual_high",
        "the surface does not fit the motion model",
        "max_residual_mm",
        "min_inlier_share",
        alarm=_A.SIGHT,
    )
    SURFACE_CHANGED = _hold(
        "surface_changed",
        "the surface or its colour changed as neither breathing nor a moving patient changes it",
        alarm=_A.PATIENT,
    )
    CAMERA_MOVED = _hold("camera_moved", "couch and floor are elsewhere than at the reference", alarm=_A.PATIENT)
    CHECK_MISSING = _hold(
        "check_missing",
        "surface, colour, scene or markers not compared with the reference for 0.5 s (or ever, if the site says so)",
        "checks_may_be_missing",
        alarm=_A.SIGHT,
    )
    JUMP = _hold("jump", "a step of a signal larger than skin can move", "max_jump_mm", alarm=_A.SIGHT)
    VALUE_INVALID = _fault("value_invalid", "a value that is not a number, or impossible", alarm=_A.STOPPED)
    BREATHING_IRREGULAR = _hold(
        "breathing_irregular",
        "breathing has ceased, or is too fast or slow (and no breath is held); a cough, where the site chose so",
        "holding_events",
        "min_breaths_per_min",
        "max_breaths_per_min",
        alarm=_A.BREATHING,
        guide=_G.FREE,
    )
    MODEL_MISSING = _hold("model_missing", "no motion model", alarm=_A.SET_UP)
    MODEL_OLD = _hold(
        "model_old", "the model was trained or compared too long ago", "max_model_age_min", alarm=_A.SET_UP
    )
    TRAINING = _hold("training", "the model is being trained", alarm=_A.SET_UP)
    REFERENCE_MISSING = _hold("reference_missing", "no reference", alarm=_A.SET_UP)
    CALIBRATION_MISSING = _hold(
        "calibration_missing",
        "a camera without a measured calibration",
        "beam_without_calibration",
        alarm=_A.SET_UP,
        source=LOCALIZATION,
    )
    CAMERA_WARMING = _hold(
        "camera_warming",
        "the camera has not run for as long as its kind needs until its readings stay",
        "warm_up_min",
        alarm=_A.SET_UP,
        source=SETUP_CAMERA,
    )
    HEAD_DIRECTION_MISSING = _hold(
        "head_direction_missing",
        "a window on a part of the patient, without a head direction",
        alarm=_A.SET_UP,
        source=PATIENT_POSITION,
    )
    RECORDER_BEHIND = _fault(
        "recorder_behind", "samples cannot be stored, or wait too long", "max_unwritten_ms", alarm=_A.STOPPED
    )
    AUDIT_BEHIND = _fault(
        "audit_behind", "transitions cannot be stored, or wait too long", "max_unwritten_ms", alarm=_A.STOPPED
    )
    DISK_LOW = _fault("disk_low", "the disk is almost full", "min_free_disk_mb", alarm=_A.STOPPED)
    SERVICE_SILENT = _fault(
        "service_silent",
        "no message from the service: no hold could arrive",
        "max_service_silence_ms",
        alarm=_A.STOPPED,
    )
    BEAM_LINE_FAILED = _fault(
        "beam_line_failed",
        "the line does not answer, or refuses a command",
        "beam_answer_ms",
        alarm=_A.BEAM_UNKNOWN,
        source=GATING_INTERLOCK,
    )
    BEAM_LINE_MISMATCH = _fault(
        "beam_line_mismatch",
        "the line's read-back differs from the command",
        "beam_settle_ms",
        alarm=_A.BEAM_UNKNOWN,
        source=GATING_INTERLOCK,
    )
    BEAM_WITHOUT_PERMIT = _fault(
        "beam_without_permit",
        "the accelerator's beam-on signal, where it is an input, without a permit",
        "beam_without_permit_ms",
        alarm=_A.BEAM_UNKNOWN,
        source=TERMINATION,
    )
    WATCHDOG = _fault("watchdog", "an armed engine makes no decision in time", "watchdog_ms", alarm=_A.BEAM_UNKNOWN)
    OPERATOR_HOLD = _hold("operator_hold", "an operator holds the beam", alarm=_A.BY_HAND, guide=_G.FREE)
    OPERATOR_LOST = _hold(
        "operator_lost",
        "no message from the page of the person who armed, or of any person where a program armed",
        "operator_timeout_s",
        alarm=_A.OPERATOR,
        guide=_G.FREE,
    )
    ENGINE_FAILED = _fault("engine_failed", "an error in the program", alarm=_A.BEAM_UNKNOWN)
    ENGINE_STOPPED = _fault("engine_stopped", "the engine is stopping", alarm=_A.STOP)
    SOURCE_ENDED = _fault("source_ended", "the recording has ended", alarm=_A.END)
    UNKNOWN = _fault("unknown", "anything else", alarm=_A.BEAM_UNKNOWN)

    @property
    def is_fault(self) -> bool:
        """Whether this latches until a named person acknowledges it."""
        return self.row.is_fault

    @property
    def is_interlock(self) -> bool:
        """Whether this is an interlock; otherwise it is gating as prescribed."""
        return bool(self.row.trips)


INTERLOCKS: tuple[HoldReason, ...] = tuple(reason for reason in HoldReason if reason.is_interlock)
"""Every interlock, in the order in which they are listed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lease:
    """A permission for the beam line to be on, which lapses by itself.

    ``expires_ns`` is host monotonic time [ns]; a line must be off at and after it, even if the engine has died.
    """

    granted_ns: int
    expires_ns: int
    sequence: int

    def is_live(self, now_ns: int) -> bool:
        """Whether the line may still be on at ``now_ns``."""
        return self.granted_ns <= now_ns < self.expires_ns
