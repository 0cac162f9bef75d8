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
    JUMP = "jump"
    FRAME_MISSING = "frame_missing"
    FRAME_LATE = "frame_late"
    OPERATOR_HOLD = "operator_hold"
    # Faults: they latch until a named person acknowledges them.
    FRAME_STALE = "frame_stale"
    FRAME_TIMEOUT = "frame_timeout"
    CLOCK_BACKWARDS = "clock_backwards"
    VALUE_INVALID = "value_invalid"
    SOURCE_LOST = "source_lost"
    BEAM_LINE_FAILED = "beam_line_failed"
    AUDIT_BEHIND = "audit_behind"
    RECORDER_BEHIND = "recorder_behind"
    DISK_LOW = "disk_low"
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
        HoldReason.JUMP,
        HoldReason.FRAME_MISSING,
        HoldReason.FRAME_LATE,
        HoldReason.OPERATOR_HOLD,
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lease:
    """A permission for the beam line to be on, which lapses by itself.

    ``expires_ns`` is host monotonic time [ns]; a line must be off at and after it, whoever is still alive.
    """

    granted_ns: int
    expires_ns: int
    sequence: int

    def is_live(self, now_ns: int) -> bool:
        """Whether the line may still be on at ``now_ns``."""
        return self.granted_ns <= now_ns < self.expires_ns
