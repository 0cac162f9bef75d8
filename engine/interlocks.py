"""Every interlock there is, in one table: what trips it, whether it latches, what bounds it, where that is from.

For whoever lists them; nothing here decides. What decides is :mod:`engine.trust` (each frame),
:mod:`engine.frame_watch` (what frames show over time), :mod:`engine.keeper` (everybody else's) and
:mod:`engine.driver` (the line).
"""

from dataclasses import dataclass

from engine.permits import HoldReason

OWN = "own"
GATING_INTERLOCK = "AAPM TG-142: gating interlock, functional"
TIMING = "AAPM TG-142: within 100 ms of expected; AAPM TG-76: 0.5 s in all"
LOCALIZATION = "AAPM TG-147: calibration of the localization system"


@dataclass(frozen=True, slots=True, kw_only=True)
class Interlock:
    """One interlock.

    Attributes
    ----------
    code
        The reason told when it trips.
    trips
        What trips it, in a few words for a physicist.
    settings
        Names of the site's settings that bound it; ``TIDEGATE_`` and capitals in the environment.
    source
        The guideline it comes from; ``own`` where none asks for it.
    """

    code: HoldReason
    trips: str
    settings: tuple[str, ...] = ()
    source: str = OWN

    @property
    def is_fault(self) -> bool:
        """Whether it latches until a named person acknowledges it; else it clears by itself, and costs a dwell."""
        return self.code.is_fault


def _row(code: HoldReason, trips: str, *settings: str, source: str = OWN) -> Interlock:
    return Interlock(code=code, trips=trips, settings=settings, source=source)


_R = HoldReason

INTERLOCKS: tuple[Interlock, ...] = (
    _row(_R.FRAME_STALE, "a frame decided on long after it came", "max_silence_ms"),
    _row(_R.FRAME_LATE, "a frame decided on late, or behind the promptest", "max_frame_age_ms", "max_lag_ms"),
    _row(_R.FRAME_MISSING, "a frame lost, or not there in time", "max_gap_ms"),
    _row(_R.FRAME_TIMEOUT, "no frame, or no new picture, for long", "max_silence_ms"),
    _row(_R.FRAME_FROZEN, "the same depth or colour picture with a new time", "max_repeated_frames"),
    _row(_R.FRAME_RATE_LOW, "too few frames within the last second", "min_fps"),
    _row(_R.CLOCK_BACKWARDS, "time or order of frames goes back, or stands still"),
    _row(_R.CLOCK_JUMPED, "the camera's clock gets ahead of the host's in a step", "max_clock_jump_ms"),
    _row(
        _R.LATENCY_HIGH,
        "from capture to the line told it took too long",
        "max_latency_ms",
        "camera_latency_ms",
        source=TIMING,
    ),
    _row(_R.SOURCE_LOST, "the camera is gone, or the recording damaged"),
    _row(_R.MARKER_LOST, "fewer than four markers, or markers of the past"),
    _row(_R.LAYOUT_CHANGED, "the markers moved against each other"),
    _row(_R.PATIENT_SHIFTED, "the markers moved along the couch, or turned", "max_shift_mm", "max_turn_deg"),
    _row(_R.COVERAGE_LOW, "too little of the region seen", "min_valid_share"),
    _row(_R.RESIDUAL_HIGH, "the surface is not the one learned", "max_residual_mm", "min_inlier_share"),
    _row(_R.JUMP, "a signal that steps further than skin can", "max_jump_mm"),
    _row(_R.VALUE_INVALID, "a value that is no number, or cannot be"),
    _row(
        _R.BREATHING_IRREGULAR, "a cough, speech, a breath that is not periodic: what the site chose", "holding_events"
    ),
    _row(_R.MODEL_MISSING, "no motion model"),
    _row(_R.MODEL_OLD, "the model was learned or found alike long ago", "max_model_age_min"),
    _row(_R.TRAINING, "the model is being learned"),
    _row(_R.REFERENCE_MISSING, "no zero"),
    _row(_R.CALIBRATION_MISSING, "a camera nothing was measured for", "beam_without_calibration", source=LOCALIZATION),
    _row(_R.RECORDER_BEHIND, "samples that cannot be kept, or wait too long", "max_unwritten_ms"),
    _row(_R.AUDIT_BEHIND, "transitions that cannot be kept, or wait too long", "max_unwritten_ms"),
    _row(_R.DISK_LOW, "the disk is almost full", "min_free_disk_mb"),
    _row(
        _R.SERVICE_SILENT,
        "nothing heard of the service: no hold would come",
        "max_service_silence_ms",
    ),
    _row(_R.BEAM_LINE_FAILED, "the line does not answer, or refuses", "beam_answer_ms", source=GATING_INTERLOCK),
    _row(_R.BEAM_LINE_MISMATCH, "the line reads back otherwise than told", "beam_settle_ms", source=GATING_INTERLOCK),
    _row(_R.WATCHDOG, "no decision of an armed engine in time", "watchdog_ms"),
    _row(_R.OPERATOR_HOLD, "a person holds the beam"),
    _row(_R.OPERATOR_LOST, "the page of the person who armed is silent", "operator_timeout_s"),
    _row(_R.ENGINE_FAILED, "a bug"),
    _row(_R.ENGINE_STOPPED, "shutting down"),
    _row(_R.SOURCE_ENDED, "the recording is over"),
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
"""Reasons that are the gate's work, not an interlock: where the window is, and how often it may switch."""
