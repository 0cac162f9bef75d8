"""Every reason to hold has a whole row, and what its row says is so."""

import dataclasses
import pickle

import pytest

from engine.core.gate_state import INTERLOCKS, AlarmGroup, Guidance, HoldReason
from engine.gating.limits import LIMIT_BOUNDS, GateLimits
from service.core.alarm_table import HOLD_TEXTS
from service.core.settings.settings import Settings

CLEARS_BY_ITSELF = [
    *("disarmed", "outside_window", "dwell", "training"),
    *("model_missing", "reference_missing", "marker_lost", "layout_changed"),
    *("coverage_low", "residual_high", "surface_changed", "camera_moved"),
    *("check_missing", "jump", "frame_missing", "frame_late"),
    *("operator_hold", "operator_lost", "frame_frozen", "frame_rate_low"),
    *("patient_shifted", "position_unchecked", "baseline_drifted", "model_old"),
    *("calibration_missing", "camera_warming", "head_direction_missing", "breathing_irregular"),
    *("phase_unknown", "range_unknown", "breath_hold_awaited", "breath_hold_settling"),
    *("breath_hold_drifted", "breath_hold_over", "shortest_off", "cycle_limit"),
    *("beam_on_limit",),
]
"""Written twice on purpose: a reason that is no fault any more is a decision, not a slip in its row."""
NO_INTERLOCKS = [
    *("disarmed", "outside_window", "dwell", "phase_unknown", "range_unknown", "breath_hold_awaited"),
    *("breath_hold_settling", "breath_hold_drifted", "breath_hold_over", "shortest_off", "cycle_limit"),
]


def test_what_latches_is_all_that_is_not_known_to_clear():
    assert sorted(reason for reason in HoldReason if not reason.is_fault) == sorted(CLEARS_BY_ITSELF)


def test_what_is_gating_is_no_interlock_and_never_latches():
    assert sorted(set(HoldReason) - set(INTERLOCKS)) == sorted(NO_INTERLOCKS)
    assert not any(HoldReason(code).is_fault for code in NO_INTERLOCKS)


@pytest.mark.parametrize("reason", HoldReason, ids=str)
def test_a_row_belongs_to_its_reason_and_its_bounds_are_settings_of_the_site(reason):
    assert HoldReason(reason.value) is reason
    assert pickle.loads(pickle.dumps(reason)) is reason
    assert set(reason.row.settings) <= set(Settings.model_fields)
    assert isinstance(reason.row.alarm, AlarmGroup)
    assert reason.row.source
    assert not (reason.is_fault and reason.row.guide is not Guidance.HIDDEN)


def test_a_code_that_is_none_is_refused():
    with pytest.raises(ValueError, match="made_up"):
        HoldReason("made_up")


def test_every_limit_of_trust_bounds_an_interlock():
    """What is left is the window's, the switching's, the lease's, or only warned of."""
    named = {name for reason in INTERLOCKS for name in reason.row.settings}
    switching = {"dwell_ms", "min_good_frames", "lease_ms", "min_on_ms", "min_off_ms", "max_cycles_per_min"}
    window = {"max_baseline_correction_mm", "max_duty_percent", "window_lower_mm", "window_upper_mm", "window"}
    others = {"warn_latency_ms", "max_reference_distance_mm", "is_calibrated", "head_direction", "is_played"}
    others |= {"needs_all_checks", "needs_countersignature", "warm_up_s", "cold_share", "breath_depths"}
    assert {field.name for field in dataclasses.fields(GateLimits)} - named == switching | window | others
    assert set(LIMIT_BOUNDS) <= named | switching | window | others


@pytest.mark.parametrize("reason", HoldReason)
def test_every_reason_has_words_for_a_therapist(reason):
    text = HOLD_TEXTS[reason]
    assert text
    assert not any(jargon in text.lower() for jargon in ("frame_", "null", "nan", "timeout", "exception", "_"))
