"""Clinical mode: a second, narrower table of bounds for the site's settings, and what a site must have.

The engine's bounds say what is possible; these say what a site may choose while it treats. Each bound has its reason,
which docs/3-operate/clinical.md prints. A session is held to the same bounds, because it may only narrow the site's.
`refusals` lists everything that is missing or out of its bound at once, so that one start names all of it.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from engine.core.breath import BreathEventKind
from engine.gating import BREATHING_CEASED
from service.core.settings.beam import BeamSettings
from service.core.settings.names import PREFIX, setting_name

NEGLIGIBLE = 1e-9
TG_302 = "2 mm, the set-up tolerance of TG-302"
EVALUATED = "the default, with which falsified recordings were evaluated (docs/5-evidence/evaluation.md)"
RESIDUAL = f"{EVALUATED}; up to 7.2 mm of misfit in a cell on the noisiest sensor (docs/2-clinical/safety.md)"
NO_BEAM = "decides nothing about the beam"
ADDRESS = "names a place, no limit"
EXEMPT: Mapping[str, str] = {
    "min_on_ms": "only lengthens a dwell",
    "max_unwritten_ms": "the engine's own bounds are as narrow",
    **dict.fromkeys(("beam_answer_ms", "beam_settle_ms"), "at most 150 ms everywhere, within max_latency_ms"),
    "max_beam_on_s": "at most 30 s everywhere",
    **dict.fromkeys(
        ("depth_exposure_us", "laser_percent"), "changes noise and gaps, which residual, coverage and QA judge"
    ),
    "keep_warm_min": "a camera that was off for longer waits for warm_up_min again",
    "retrain_interval_min": "a new model is compared as a refit is, and its age is bounded by max_model_age_min",
    "beam_on_input": ADDRESS,
    "beam_simulated_accelerator_ms": "of the simulated line, which clinical mode refuses",
    "beam_rtu_baud": ADDRESS,
    "beam_rtu_stop_bits": ADDRESS,
    **dict.fromkeys(("beam_modbus_", "beam_relay_"), ADDRESS),
    "qa_": "tolerances of QA permit nothing; the engine's bounds are those of the physicist",
    **dict.fromkeys(
        (
            "port",
            "pacs_commit_port",
            "max_live_clients",
        ),
        "HTTP service, which holds no permit",
    ),
    **dict.fromkeys(
        (
            "raw_min_free_mb",
            "retain_",
            "data_quota_gb",
            "session_room_min",
        ),
        "files and records; a full disk holds by min_free_disk_mb",
    ),
    **dict.fromkeys(
        ("oidc_", "login_", "key_max_days", "audit_log_"),
        "access and its records: an end of a log-in holds, and operator_timeout_s bounds absence",
    ),
}
"""Numbers without a clinical bound, by name or by the beginning of the name, and why."""
WINDOW_NUMBERS: Mapping[str, str] = {
    "lower_mm": "window_lower_mm",
    "upper_mm": "window_upper_mm",
    "still_mm": "max_hold_still_mm",
    "still_l": "max_hold_still_mm",
    "max_drift_mm": "max_hold_drift_mm",
    "max_drift_l": "max_hold_drift_mm",
    "settle_ms": "min_hold_settle_ms",
    "timeout_s": "max_breath_hold_s",
    "min_confidence": "min_phase_confidence",
    "dwell_ms": "min_dwell_ms",
    "min_off_ms": "min_off_ms",
    "max_cycles_per_min": "max_cycles_per_min",
    "from_percent": "max_duty_percent",
    "to_percent": "max_duty_percent",
    "lower_percent": "window_lower_mm",
    "upper_percent": "window_upper_mm",
    "lower_l": "max_duty_percent",
    "upper_l": "max_duty_percent",
}
"""The setting that bounds each number of a session's window."""
WINDOW_EXEMPT: Mapping[str, str] = {
    "row": ADDRESS,
    "column": ADDRESS,
    "min_on_ms": "only lengthens a dwell",
    **dict.fromkeys(("hysteresis_mm", "hysteresis_l", "hysteresis_percent"), "only narrows the window"),
}
"""Numbers of a window without a bound, and why."""
MEASURED = "treatment needs a measured calibration"
RESEARCH_ONLY: Mapping[str, str] = {
    "beam_without_calibration": MEASURED,
    "allow_device_registration": MEASURED,
    "checks_may_be_missing": "what no check can look at is not known to be right",
    "recordings_may_gate": "a recording does not show the present patient",
}
"""Settings that must be false in clinical mode, and why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClinicalBound:
    """Lowest and highest value of a setting in clinical mode, and the reason."""

    low: float
    high: float
    reason: str

    @property
    def text(self) -> str:
        """The bound as a refusal says it."""
        return f"{self.low:g} to {self.high:g}"


def _within(low: float, high: float, reason: str) -> ClinicalBound:
    return ClinicalBound(low=low, high=high, reason=reason)


CLINICAL_BOUNDS: Mapping[str, ClinicalBound] = {
    # What a site must set: the defaults are outside.
    "camera_latency_ms": _within(
        1.0, 150.0, "measured, because 0 means unmeasured; 150 ms leave time for the rest within 500 ms"
    ),
    "qa_required_daily_h": _within(1.0, 24.0, "TG-142 asks for daily QA"),
    "qa_latency_max_age_days": _within(1.0, 400.0, "TG-142, TG-302: annually, and a month to find the day"),
    "operator_timeout_s": ClinicalBound(
        low=3.0,
        high=30.0,
        reason="a page sends its presence every second; after half a minute without one no person watches",
    ),
    "min_dwell_ms": ClinicalBound(
        low=100.0,
        high=10_000.0,
        reason="three frames at 30 frames a second: no shorter visit to the window is evidence",
    ),
    "window_lower_mm": _within(
        -20.0, 20.0, "below the end of exhale lies no breath, only expiration breath holds and drift"
    ),
    "window_upper_mm": _within(-20.0, 40.0, "deep inspiration breath holds lift the chest by up to 40 mm"),
    "max_duty_percent": _within(10.0, 90.0, "the default: a window that the patient never leaves gates nothing"),
    "min_off_ms": _within(1_000.0, 60_000.0, "makers of accelerators ask for a second between beam off and beam on"),
    "max_cycles_per_min": _within(1, 60, "with a second off before each, no more are possible"),
    "min_breaths_per_min": _within(1.0, 30.0, "makers of accelerators gate 1 to 30 breaths a minute"),
    "max_breaths_per_min": _within(10.0, 30.0, "makers of accelerators gate 1 to 30 breaths a minute"),
    # Where the patient may be.
    "max_shift_mm": _within(1.0, 4.0, f"{TG_302}, and 2 mm by which markers follow the breath along the couch"),
    "max_turn_deg": _within(0.5, 2.0, "moves a point 60 mm from the centre by 2 mm (TG-302)"),
    "max_marker_travel_mm": _within(
        0.5, 6.0, "on skin they travel by 3 to 5 mm with the breath, as recorded markers on people do"
    ),
    "max_height_mm": _within(0.5, 3.0, f"{TG_302}, and 1 mm of the estimate's own error"),
    "max_baseline_drift_mm": _within(0.5, 2.0, TG_302),
    "max_reference_distance_mm": _within(0.5, 2.0, TG_302),
    "max_position_shift_mm": _within(0.5, 2.0, TG_302),
    "max_position_turn_deg": _within(0.2, 1.0, "moves a point 115 mm from the middle by 2 mm"),
    "max_position_shape_mm": _within(0.5, 2.0, "the default: another body differs by more"),
    "marker_placement_mm": _within(
        1.0, 50.0, "markers are put back on tattoos no better: a smaller one determines by assumption"
    ),
    "max_baseline_correction_mm": _within(
        0.0, 3.0, "a patient who lies further off needs a new reference, not a correction"
    ),
    # Whether a measurement counts.
    "max_residual_mm": _within(0.1, 3.0, RESIDUAL),
    "max_jump_mm": _within(0.1, 4.0, "120 mm/s at 30 frames a second: no breath is faster"),
    "min_valid_share": _within(0.8, 1.0, "QA warns when 10 % of the plate are missing, fails at 20 %"),
    "min_inlier_share": _within(0.6, 1.0, EVALUATED),
    "min_signal_share": _within(0.7, 1.0, EVALUATED),
    "min_wide_share": _within(0.9, 1.0, EVALUATED),
    "warm_up_min": _within(5.0, 240.0, "no kind of camera was seen to be steady earlier"),
    "max_model_age_min": _within(1.0, 240.0, "the default: longer than a fraction"),
    "min_phase_confidence": _within(0.6, 1.0, "the default: the phase is compared with the patient's breaths"),
    "max_hold_still_mm": _within(0.05, 2.0, "a breath that moves by more within the time of settling is not held"),
    "max_hold_drift_mm": _within(0.1, 3.0, f"{TG_302}, and 1 mm by which a held chest sinks"),
    "min_hold_settle_ms": _within(500.0, 10_000.0, "longer than the turn of a breath, which is still for a moment"),
    "max_breath_hold_s": _within(5.0, 60.0, "breath holds in treatment last 20 to 40 s"),
    # Whether a frame is fresh.
    "min_good_frames": _within(3, 300, "the default: a tenth of a second of agreeing frames at 30 a second"),
    "lease_ms": _within(20.0, 100.0, "TG-142: gate within 100 ms"),
    "max_frame_age_ms": _within(5.0, 100.0, "TG-142: surrogate within 100 ms"),
    "max_gap_ms": _within(10.0, 100.0, "TG-142: surrogate within 100 ms"),
    "max_lag_ms": _within(20.0, 100.0, "TG-142: surrogate within 100 ms"),
    "watchdog_ms": _within(40.0, 250.0, "the default and a quarter: an engine that does not decide is a fault"),
    "max_silence_ms": _within(50.0, 500.0, "TG-76: 500 ms in total"),
    "max_latency_ms": _within(100.0, 500.0, "TG-76: 500 ms in total"),
    "warn_latency_ms": _within(20.0, 100.0, "TG-142: 100 ms"),
    "max_service_silence_ms": _within(100.0, 500.0, "no hold by hand arrives meanwhile"),
    "max_clock_jump_ms": _within(50.0, 250.0, "the default"),
    "min_fps": _within(15.0, 60.0, "a frame every 67 ms, within the 100 ms of TG-142"),
    # Whether a stored model is this patient's.
    "likeness_max_shift_mm": _within(1.0, 10.0, "half of the default: a model is valid where it was learned"),
    "likeness_max_tilt_deg": _within(0.5, 3.0, "moves a point 60 mm from the centre by 3 mm"),
    "likeness_max_shape_mm": _within(0.5, 3.0, "the default"),
    "likeness_max_residual_mm": _within(0.1, 3.0, "as for every frame"),
    # What a model is learned from.
    "training_min_frames": _within(100, 225, "the default"),
    "training_min_cycles": _within(3, 50, "the default: one breath is no pattern"),
    "training_min_seconds": _within(10.0, 300.0, "the default: three breaths of 3 s"),
    "training_max_seconds": _within(10.0, 120.0, "no shorter than is needed at least"),
    # Whether the beam line follows.
    "beam_without_permit_ms": _within(20.0, 250.0, "the default, above the accelerator's delay"),
    "beam_absent_s": _within(1.0, 30.0, "a beam that is not delivered for longer is looked at"),
    "min_free_disk_mb": _within(100.0, 1_000_000.0, "an hour's samples"),
}
"""The bounds of clinical mode, by setting; `EXEMPT` names every other number, and why it needs none."""


def refusals(settings: BeamSettings, holding_events: Iterable[BreathEventKind]) -> tuple[str, ...]:
    """Return one line for each thing that clinical mode lacks or refuses; empty if it may start.

    Parameters
    ----------
    settings
        All of the site's settings, of which those of the beam line are known here by type.
    holding_events
        The breathing events that hold the site's beam.
    """
    return tuple(f"{PREFIX}MODE is clinical: {line}" for line in _lines(settings, holding_events))


def _lines(settings: BeamSettings, holding_events: Iterable[BreathEventKind]) -> Iterator[str]:
    yield from _line_lines(settings)
    yield from _research_lines(settings)
    yield from _event_lines(holding_events)
    for name, bound in CLINICAL_BOUNDS.items():
        value = getattr(settings, name)
        if value is not None and not bound.low - NEGLIGIBLE <= value <= bound.high + NEGLIGIBLE:
            yield f"{setting_name(name)} is {value:g}: must be {bound.text} ({bound.reason})"


def _line_lines(settings: BeamSettings) -> Iterator[str]:
    """Yield what is missing of the beam line."""
    if settings.is_simulated_beam:
        yield f"{PREFIX}BEAM_LINE is simulated: set a real line, or the mode to research"
    if settings.beam_lines == ("serial-relay",) and settings.beam_heartbeat_channel is None:
        yield (
            "a relay board alone stays on when this process is killed: "
            "set beam.relay_heartbeat_channel, or a Modbus line beside it"
        )
    if len(settings.beam_lines) == 1 and not settings.hardware_dead_man:
        yield (
            f"one beam line has no second way off: set {PREFIX}BEAM_LINE_2, or declare a tested device that drops the "
            f"beam without this computer with {PREFIX}HARDWARE_DEAD_MAN=true"
        )


def _event_lines(holding_events: Iterable[BreathEventKind]) -> Iterator[str]:
    """Yield the breathing events that must hold the beam and do not."""
    missing = sorted(BREATHING_CEASED.difference(holding_events))
    if missing:
        yield f"{PREFIX}HOLDING_EVENTS lacks {' and '.join(missing)}: must hold the beam (breathing has ceased)"


def _research_lines(settings: BeamSettings) -> Iterator[str]:
    """Yield what is for research alone."""
    for name, reason in RESEARCH_ONLY.items():
        if getattr(settings, name):
            yield f"{setting_name(name)} is true: must be false ({reason})"
