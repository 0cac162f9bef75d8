"""The words of the gate: states, reasons to hold, and the lease that lets the beam line be on.

They stand below stages and beam lines because both speak them, and neither may import the other.
"""

import enum
from dataclasses import dataclass


class GateState(enum.StrEnum):
    """Where the gate stands; only ``BEAM_ON`` ever comes with a lease."""

    DISARMED = "disarmed"
    HOLD = "hold"
    DWELL = "dwell"
    BEAM_ON = "beam_on"
    FAULT = "fault"


class HoldReason(enum.StrEnum):
    """Why the beam is held. The value is the stable code used in files, the API and the audit."""

    # Holds: they clear by themselves, after a full dwell.
    DISARMED = "disarmed"
    OUTSIDE_WINDOW = "outside_window"
    DWELL = "dwell"
    TRAINING = "training"
    MODEL_MISSING = "model_missing"
    REFERENCE_MISSING = "reference_missing"
    MARKER_LOST = "marker_lost"
    LAYOUT_CHANGED = "layout_changed"
    COVERAGE_LOW = "coverage_low"
    RESIDUAL_HIGH = "residual_high"
    SURFACE_CHANGED = "surface_changed"
    CAMERA_MOVED = "camera_moved"
    CHECK_MISSING = "check_missing"
    JUMP = "jump"
    FRAME_MISSING = "frame_missing"
    FRAME_LATE = "frame_late"
    OPERATOR_HOLD = "operator_hold"
    OPERATOR_LOST = "operator_lost"
    FRAME_FROZEN = "frame_frozen"
    FRAME_RATE_LOW = "frame_rate_low"
    PATIENT_SHIFTED = "patient_shifted"
    POSITION_UNCHECKED = "position_unchecked"
    BASELINE_DRIFTED = "baseline_drifted"
    MODEL_OLD = "model_old"
    CALIBRATION_MISSING = "calibration_missing"
    HEAD_DIRECTION_MISSING = "head_direction_missing"
    BREATHING_IRREGULAR = "breathing_irregular"
    PHASE_UNKNOWN = "phase_unknown"
    RANGE_UNKNOWN = "range_unknown"
    BREATH_HOLD_AWAITED = "breath_hold_awaited"
    BREATH_HOLD_SETTLING = "breath_hold_settling"
    BREATH_HOLD_DRIFTED = "breath_hold_drifted"
    BREATH_HOLD_OVER = "breath_hold_over"
    SHORTEST_OFF = "shortest_off"
    CYCLE_LIMIT = "cycle_limit"
    BEAM_ON_LIMIT = "beam_on_limit"
    # Faults: they latch until a named person acknowledges them.
    FRAME_STALE = "frame_stale"
    FRAME_TIMEOUT = "frame_timeout"
    CLOCK_BACKWARDS = "clock_backwards"
    CLOCK_JUMPED = "clock_jumped"
    LATENCY_HIGH = "latency_high"
    VALUE_INVALID = "value_invalid"
    SOURCE_LOST = "source_lost"
    BEAM_LINE_FAILED = "beam_line_failed"
    BEAM_LINE_MISMATCH = "beam_line_mismatch"
    BEAM_WITHOUT_PERMIT = "beam_without_permit"
    AUDIT_BEHIND = "audit_behind"
    RECORDER_BEHIND = "recorder_behind"
    DISK_LOW = "disk_low"
    SERVICE_SILENT = "service_silent"
    WATCHDOG = "watchdog"
    ENGINE_FAILED = "engine_failed"
    # Ways out.
    SOURCE_ENDED = "source_ended"
    ENGINE_STOPPED = "engine_stopped"
    UNKNOWN = "unknown"

    @property
    def is_fault(self) -> bool:
        """Whether this latches until a named person acknowledges it; anything not known to clear does."""
        return self not in _CLEARS_BY_ITSELF


_CLEARS_BY_ITSELF = frozenset(
    {
        HoldReason.DISARMED,
        HoldReason.OUTSIDE_WINDOW,
        HoldReason.DWELL,
        HoldReason.TRAINING,
        HoldReason.MODEL_MISSING,
        HoldReason.REFERENCE_MISSING,
        HoldReason.MARKER_LOST,
        HoldReason.LAYOUT_CHANGED,
        HoldReason.COVERAGE_LOW,
        HoldReason.RESIDUAL_HIGH,
        HoldReason.SURFACE_CHANGED,
        HoldReason.CAMERA_MOVED,
        HoldReason.CHECK_MISSING,
        HoldReason.JUMP,
        HoldReason.FRAME_MISSING,
        HoldReason.FRAME_LATE,
        HoldReason.OPERATOR_HOLD,
        HoldReason.OPERATOR_LOST,
        HoldReason.FRAME_FROZEN,
        HoldReason.FRAME_RATE_LOW,
        HoldReason.PATIENT_SHIFTED,
        HoldReason.POSITION_UNCHECKED,
        HoldReason.BASELINE_DRIFTED,
        HoldReason.MODEL_OLD,
        HoldReason.CALIBRATION_MISSING,
        HoldReason.HEAD_DIRECTION_MISSING,
        HoldReason.BREATHING_IRREGULAR,
        HoldReason.PHASE_UNKNOWN,
        HoldReason.RANGE_UNKNOWN,
        HoldReason.BREATH_HOLD_AWAITED,
        HoldReason.BREATH_HOLD_SETTLING,
        HoldReason.BREATH_HOLD_DRIFTED,
        HoldReason.BREATH_HOLD_OVER,
        HoldReason.SHORTEST_OFF,
        HoldReason.CYCLE_LIMIT,
        HoldReason.BEAM_ON_LIMIT,
    }
)


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
