"""All interlocks in one table: what trips each one, whether it latches, its limits, and its source.

For display and documentation; nothing here decides. The decisions are in :mod:`engine.gating.frame_checks` (each
frame), :mod:`engine.gating.supervision.supervisor` (frames over time), :mod:`engine.control.gate_controller` (commands
and other threads) and :mod:`engine.control.beam_driver` (the line).
"""

from dataclasses import dataclass

from engine.core.gate_state import HoldReason

OWN = "own"
GATING_INTERLOCK = "AAPM TG-142: gating interlock, functional"
TIMING = "AAPM TG-142: within 100 ms of expected; AAPM TG-76: 0.5 s in all"
PATIENT_POSITION = "DICOM PS3.3 C.7.3.1.1.2: patient position"
SETUP = "AAPM TG-302: position by the surface before treatment; AAPM TG-147"
TERMINATION = "IEC 60601-2-1: termination of irradiation; AAPM TG-142: gating interlock, functional"
LOCALIZATION = "AAPM TG-147: calibration of the localization system"


@dataclass(frozen=True, slots=True, kw_only=True)
class Interlock:
    """One interlock.

    Attributes
    ----------
    code
        The hold reason when it trips.
    trips
        What trips it, in a few words.
    settings
        Names of the site's settings that bound it; ``TIDEGATE_`` and capitals in the environment.
    source
        The guideline that demands it; ``own`` where none does.
    """

    code: HoldReason
    trips: str
    settings: tuple[str, ...] = ()
    source: str = OWN

    @property
    def is_fault(self) -> bool:
        """Whether it latches until an operator acknowledges it; otherwise it clears by itself, after a dwell."""
        return self.code.is_fault


def _row(code: HoldReason, trips: str, *settings: str, source: str = OWN) -> Interlock:
    return Interlock(code=code, trips=trips, settings=settings, source=source)


_R = HoldReason

INTERLOCKS: tuple[Interlock, ...] = (
    _row(_R.FRAME_STALE, "a frame much too old at its decision", "max_silence_ms"),
    _row(
        _R.FRAME_LATE,
        "a frame too old at its decision, delayed against the fastest one, or not known to be fresh for 5 s",
        "max_frame_age_ms",
        "max_lag_ms",
    ),
    _row(_R.FRAME_MISSING, "a frame lost or not received in time", "max_gap_ms"),
    _row(_R.FRAME_TIMEOUT, "no frame, or no new picture, for too long", "max_silence_ms"),
    _row(_R.FRAME_FROZEN, "an old depth or colour picture with a new time"),
    _row(_R.FRAME_RATE_LOW, "too few frames within the last second", "min_fps"),
    _row(_R.CLOCK_BACKWARDS, "time or order of frames does not increase"),
    _row(
        _R.CLOCK_JUMPED,
        "a step of the camera's clock against the host's, or a rate that differs by more than 200 ppm for two minutes",
        "max_clock_jump_ms",
    ),
    _row(
        _R.LATENCY_HIGH,
        "latency from capture to the command of the line too high",
        "max_latency_ms",
        "camera_latency_ms",
        source=TIMING,
    ),
    _row(_R.SOURCE_LOST, "the camera is disconnected, or the recording damaged"),
    _row(_R.MARKER_LOST, "fewer than four markers found, or a colour picture too old"),
    _row(_R.LAYOUT_CHANGED, "distances between the markers changed"),
    _row(
        _R.PATIENT_SHIFTED,
        "the markers moved along the couch, rotated, or slide with the breath; or the surface moved as a whole",
        "max_shift_mm",
        "max_marker_travel_mm",
        "max_turn_deg",
        "max_height_mm",
    ),
    _row(
        _R.POSITION_UNCHECKED,
        "in a later fraction, the position was not compared with the plan's and signed, or the patient moved since",
        "max_position_shift_mm",
        "max_position_turn_deg",
        "max_position_shape_mm",
        source=SETUP,
    ),
    _row(
        _R.BASELINE_DRIFTED,
        "in an amplitude window, the end of exhale drifted, or is not known after a jump or 1 s unmeasured",
        "max_baseline_drift_mm",
    ),
    _row(
        _R.BEAM_ON_LIMIT,
        "in an amplitude or phase window, beam for too long without the signal's leaving the window",
        "max_beam_on_s",
    ),
    _row(
        _R.COVERAGE_LOW,
        "too little of the region or of a gated signal visible",
        "min_valid_share",
        "min_signal_share",
        "min_wide_share",
    ),
    _row(_R.RESIDUAL_HIGH, "the surface does not fit the motion model", "max_residual_mm", "min_inlier_share"),
    _row(_R.SURFACE_CHANGED, "the surface or its colour changed as neither breathing nor a moving patient changes it"),
    _row(_R.CAMERA_MOVED, "couch and floor are elsewhere than at the reference"),
    _row(
        _R.CHECK_MISSING,
        "surface, colour or scene could not be compared with the reference for 0.5 s (or ever, if the site says so)",
        "checks_may_be_missing",
    ),
    _row(_R.JUMP, "a step of a signal larger than skin can move", "max_jump_mm"),
    _row(_R.VALUE_INVALID, "a value that is not a number, or impossible"),
    _row(
        _R.BREATHING_IRREGULAR,
        "breathing has ceased, or is too fast or slow (and no breath is held); a cough, where the site chose so",
        "holding_events",
        "min_breaths_per_min",
        "max_breaths_per_min",
    ),
    _row(_R.MODEL_MISSING, "no motion model"),
    _row(_R.MODEL_OLD, "the model was trained or compared too long ago", "max_model_age_min"),
    _row(_R.TRAINING, "the model is being trained"),
    _row(_R.REFERENCE_MISSING, "no reference"),
    _row(
        _R.CALIBRATION_MISSING,
        "a camera without a measured calibration",
        "beam_without_calibration",
        source=LOCALIZATION,
    ),
    _row(
        _R.HEAD_DIRECTION_MISSING,
        "a window on a part of the patient, without a head direction",
        source=PATIENT_POSITION,
    ),
    _row(_R.RECORDER_BEHIND, "samples cannot be stored, or wait too long", "max_unwritten_ms"),
    _row(_R.AUDIT_BEHIND, "transitions cannot be stored, or wait too long", "max_unwritten_ms"),
    _row(_R.DISK_LOW, "the disk is almost full", "min_free_disk_mb"),
    _row(
        _R.SERVICE_SILENT,
        "no message from the service: no hold could arrive",
        "max_service_silence_ms",
    ),
    _row(
        _R.BEAM_LINE_FAILED, "the line does not answer, or refuses a command", "beam_answer_ms", source=GATING_INTERLOCK
    ),
    _row(
        _R.BEAM_LINE_MISMATCH,
        "the line's read-back differs from the command",
        "beam_settle_ms",
        source=GATING_INTERLOCK,
    ),
    _row(
        _R.BEAM_WITHOUT_PERMIT,
        "the accelerator's beam-on signal, where it is an input, without a permit",
        "beam_without_permit_ms",
        source=TERMINATION,
    ),
    _row(_R.WATCHDOG, "an armed engine makes no decision in time", "watchdog_ms"),
    _row(_R.OPERATOR_HOLD, "an operator holds the beam"),
    _row(
        _R.OPERATOR_LOST,
        "no message from the page of the person who armed, or of any person where a program armed",
        "operator_timeout_s",
    ),
    _row(_R.ENGINE_FAILED, "an error in the program"),
    _row(_R.ENGINE_STOPPED, "the engine is stopping"),
    _row(_R.SOURCE_ENDED, "the recording has ended"),
    _row(_R.UNKNOWN, "anything else"),
)

NO_INTERLOCKS = frozenset(
    {
        _R.DISARMED,
        _R.OUTSIDE_WINDOW,
        _R.DWELL,
        _R.PHASE_UNKNOWN,
        _R.RANGE_UNKNOWN,
        _R.BREATH_HOLD_AWAITED,
        _R.BREATH_HOLD_SETTLING,
        _R.BREATH_HOLD_DRIFTED,
        _R.BREATH_HOLD_OVER,
        _R.SHORTEST_OFF,
        _R.CYCLE_LIMIT,
    }
)
"""Hold reasons that are normal gating and no interlock: the window, and the switching limits."""
