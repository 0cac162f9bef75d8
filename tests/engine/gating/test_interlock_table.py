"""The table of interlocks is whole, and what it says is so."""

import dataclasses

import pytest

from engine.core.gate_state import HoldReason
from engine.gating.interlock_table import INTERLOCKS, NO_INTERLOCKS
from engine.gating.limits import LIMIT_BOUNDS, GateLimits
from service.core.hold_texts import HOLD_TEXTS
from service.core.settings.settings import Settings


def test_every_reason_is_an_interlock_or_said_to_be_none_and_none_is_both():
    codes = [interlock.code for interlock in INTERLOCKS]
    assert len(codes) == len(set(codes))
    assert set(codes) | NO_INTERLOCKS == set(HoldReason)
    assert not set(codes) & NO_INTERLOCKS


def test_what_is_no_interlock_never_latches():
    assert not any(reason.is_fault for reason in NO_INTERLOCKS)


@pytest.mark.parametrize("interlock", INTERLOCKS, ids=lambda one: one.code.value)
def test_every_bound_named_is_a_setting_of_the_site(interlock):
    assert set(interlock.settings) <= set(Settings.model_fields)
    assert interlock.source
    assert interlock.trips


def test_every_limit_of_trust_bounds_an_interlock():
    """What is left is the window's, the switching's, the lease's, or only warned of."""
    named = {name for interlock in INTERLOCKS for name in interlock.settings}
    switching = {"dwell_ms", "min_good_frames", "lease_ms", "min_on_ms", "min_off_ms", "max_cycles_per_min"}
    window = {"max_baseline_correction_mm", "max_duty_percent", "window_lower_mm", "window_upper_mm", "window"}
    others = {"warn_latency_ms", "max_reference_distance_mm", "is_calibrated", "head_direction", "is_played"}
    others |= {"needs_all_checks", "needs_countersignature"}
    assert {field.name for field in dataclasses.fields(GateLimits)} - named == switching | window | others
    assert set(LIMIT_BOUNDS) <= named | switching | window | others


@pytest.mark.parametrize("reason", HoldReason)
def test_every_reason_has_words_for_a_therapist(reason):
    text = HOLD_TEXTS[reason]
    assert text
    assert not any(jargon in text.lower() for jargon in ("frame_", "null", "nan", "timeout", "exception", "_"))
