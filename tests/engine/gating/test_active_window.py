"""The window in use: its correction's bounds, the site's limits of every leaf, and its edges as text."""

from dataclasses import replace

import pytest

from engine.core.breath import SignalChoice
from engine.core.errors import InvalidValueError
from engine.gating.active_window import ActiveWindow, refuse_wide, window_text
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, JoinedWindow, PhaseWindow
from tests.support.gating.streams import LIMITS

SITE = replace(LIMITS, window_lower_mm=-5.0, window_upper_mm=30.0)
THORAX = SignalChoice(signal="thorax")
LOWEST = AmplitudeWindow(lower=-5.0, upper=3.0)
HIGHEST = AmplitudeWindow(choice=THORAX, lower=0.0, upper=30.0)
PHASE = PhaseWindow(from_percent=30.0, to_percent=70.0)


def joined(*conditions):
    return JoinedWindow(conditions=conditions, join="and")


@pytest.mark.parametrize(
    "window",
    [LOWEST, HIGHEST, joined(LOWEST, HIGHEST), BreathHoldWindow(level=HIGHEST)],
    ids=["lowest", "highest", "both", "breath hold"],
)
def test_edges_at_the_site_s_limits_are_within_them(window):
    refuse_wide(window, SITE)


@pytest.mark.parametrize(
    ("leaf", "field", "value", "bound"),
    [
        (replace(LOWEST, lower=-5.1), "window.lower_mm", "-5.1", "at least -5, the site's limit"),
        (replace(HIGHEST, upper=30.1), "window.upper_mm", "30.1", "at most 30, the site's limit"),
    ],
)
def test_an_edge_beyond_the_site_s_limits_is_refused_in_every_kind_and_place_of_a_window(leaf, field, value, bound):
    percent = AmplitudeWindow(lower=0.0, upper=200.0, unit="percent")
    for window in (leaf, BreathHoldWindow(level=leaf), joined(PHASE, leaf), joined(percent, leaf), joined(leaf, PHASE)):
        with pytest.raises(InvalidValueError) as refusal:
            refuse_wide(window, SITE)
        assert (refusal.value.field, refusal.value.value, refusal.value.bound) == (field, value, bound)


def test_a_correction_up_to_the_site_s_limit_is_possible_in_both_directions():
    active = ActiveWindow(requested=LOWEST, converted=LOWEST)
    most = LIMITS.max_baseline_correction_mm
    for by in (-most, most):
        assert active.corrected(by, LIMITS).window == LOWEST.shifted(LOWEST.choice, by)
        with pytest.raises(InvalidValueError):
            active.corrected(1.001 * by, LIMITS)


def test_a_window_in_per_cent_is_not_corrected():
    percent = AmplitudeWindow(lower=0.0, upper=30.0, unit="percent")
    with pytest.raises(InvalidValueError, match="the breathing range is not known yet"):
        ActiveWindow(requested=percent, converted=percent).corrected(0.5, LIMITS)


def test_the_text_names_every_leaf():
    hold = BreathHoldWindow(level=HIGHEST)
    assert window_text(joined(LOWEST, hold, PHASE)) == (
        "whole -5 to 3 mm, thorax 0 to 30 mm, whole 30 to 70 % of the breath"
    )
