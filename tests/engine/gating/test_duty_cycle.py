"""A window that the learned breaths practically never leave cannot be armed."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import WHOLE, SignalChoice
from engine.core.errors import CommandRefusedError, InvalidValueError
from engine.core.signals import ranges_of
from engine.gating.active_window import duty_percent, is_predicted, refuse_hold_in_free_breath, refuse_never_left
from engine.gating.limits import GateLimits
from engine.gating.windows import (
    AmplitudeWindow,
    BreathHoldWindow,
    Join,
    JoinedWindow,
    PhaseWindow,
    Unit,
    amplitude_window,
)

ABDOMEN = SignalChoice(signal="abdomen")
LEVELS = {WHOLE: np.linspace(0.05, 9.95, 100), ABDOMEN: np.linspace(19.9, 0.1, 100)}
"""Frames of the training: the whole region from 0 to 10 mm, and the abdomen from 20 to 0 mm."""
HOLD = BreathHoldWindow(level=amplitude_window(lower_mm=0.0, upper_mm=100.0))


def window(lower_mm, upper_mm, signal="whole"):
    return amplitude_window(signal=signal, lower_mm=lower_mm, upper_mm=upper_mm)


def hold(lower_mm, upper_mm, kind="inspiration"):
    return BreathHoldWindow(level=window(lower_mm, upper_mm), kind=kind)


def phase(from_percent, to_percent):
    return PhaseWindow(from_percent=from_percent, to_percent=to_percent)


def joined(join, *conditions):
    return JoinedWindow(conditions=conditions, join=join)


@pytest.mark.parametrize(
    ("wanted", "percent"),
    [
        (window(-1.0, 3.0), 30.0),
        (window(9.0, 20.0), 10.0),
        (window(-5.0, 15.0), 100.0),
        (window(20.0, 30.0), 0.0),
        (phase(40.0, 70.0), 30.0),
        (phase(95.0, 5.0), 10.0),
        (joined(Join.AND, window(0.0, 6.0), window(0.0, 16.0, "abdomen")), 40.0),
        (joined(Join.OR, window(0.0, 2.0), window(0.0, 2.0, "abdomen")), 30.0),
        (joined(Join.AND, window(0.0, 6.0), phase(0.0, 50.0)), 50.0),
        (joined(Join.AND, phase(0.0, 50.0), PhaseWindow(choice=ABDOMEN, from_percent=25.0, to_percent=75.0)), 25.0),
        (joined(Join.OR, phase(0.0, 20.0), phase(10.0, 40.0)), 40.0),
        (joined(Join.OR, window(0.0, 6.0), phase(0.0, 70.0)), 100.0),
        (joined(Join.OR, window(0.0, 3.0), HOLD), 100.0),
        (joined(Join.OR, window(0.0, 3.0), hold(9.0, 20.0)), 40.0),
        (joined(Join.OR, hold(0.0, 1.0), hold(9.0, 20.0)), 20.0),
    ],
)
def test_the_share_of_the_learned_breaths_inside_is_predicted(wanted, percent):
    assert duty_percent(wanted, LEVELS) == pytest.approx(percent, abs=0.2)


def test_hysteresis_does_not_make_a_window_narrower():
    assert duty_percent(amplitude_window(lower_mm=0.0, upper_mm=5.0, hysteresis_mm=2.0), LEVELS) == pytest.approx(50.0)


@pytest.mark.parametrize("wanted", [HOLD, joined(Join.AND, window(-50.0, 50.0), HOLD)])
def test_a_breath_hold_has_no_predicted_duty_cycle_and_is_not_refused(wanted):
    assert not is_predicted(wanted)
    assert duty_percent(wanted, LEVELS) is None
    refuse_never_left(GateLimits(window=wanted), {})


def test_a_window_that_is_never_left_is_refused_with_its_name_the_duty_cycle_and_the_bound():
    with pytest.raises(InvalidValueError) as refusal:
        refuse_never_left(GateLimits(window=window(-30.0, 9.5)), LEVELS)
    assert refusal.value.field == "window"
    for part in ("whole -30 to 9.5 mm", "95 %", "90 %"):
        assert part in str(refusal.value)


def test_the_bound_is_the_sites_and_itself_allowed():
    limits = GateLimits(window=window(0.0, 9.0), max_duty_percent=90.0)
    refuse_never_left(limits, LEVELS)
    with pytest.raises(InvalidValueError, match="at most 89 % may"):
        refuse_never_left(replace(limits, max_duty_percent=89.0), LEVELS)
    refuse_never_left(GateLimits(window=window(-30.0, 30.0), max_duty_percent=100.0), LEVELS)
    with pytest.raises(InvalidValueError):
        refuse_never_left(GateLimits(window=phase(5.0, 99.0)), {})


@pytest.mark.parametrize(
    ("wanted", "levels"),
    [
        (window(0.0, 1.0), {}),
        (window(0.0, 1.0, "abdomen"), {WHOLE: LEVELS[WHOLE]}),
        (joined(Join.OR, window(0.0, 1.0), window(0.0, 1.0, "abdomen")), {WHOLE: LEVELS[WHOLE]}),
        (AmplitudeWindow(lower=0.0, upper=30.0, unit=Unit.PERCENT), LEVELS),
    ],
)
def test_an_unknown_duty_cycle_is_refused(wanted, levels):
    assert duty_percent(wanted, levels) is None
    with pytest.raises(CommandRefusedError, match="Train again"):
        refuse_never_left(GateLimits(window=wanted), levels)


@pytest.mark.parametrize(("level_mm", "percent"), [(-1.0, 100.0), (3.0, 100.0), (-1.001, 0.0), (3.001, 0.0)])
def test_a_level_at_an_edge_counts_as_inside(level_mm, percent):
    window = AmplitudeWindow(lower=-1.0, upper=3.0)
    assert duty_percent(window, {WHOLE: np.full(60, level_mm)}) == percent


RANGE = {WHOLE: np.linspace(0.0, 10.0, 2001)}
LOWEST_MM, HIGHEST_MM = ranges_of(RANGE)[WHOLE].low, ranges_of(RANGE)[WHOLE].high


def at(percent):
    return LOWEST_MM + 0.01 * percent * (HIGHEST_MM - LOWEST_MM)


@pytest.mark.parametrize(
    ("kind", "lower", "upper", "is_refused"),
    [
        ("inspiration", 60.1, 150.0, False),
        ("inspiration", 59.9, 150.0, True),
        ("inspiration", 80.0, 100.1, False),
        ("inspiration", 80.0, 99.9, True),
        ("inspiration", -10.0, 30.0, True),
        ("inspiration", 180.0, 250.0, False),
        ("expiration", -30.0, 39.9, False),
        ("expiration", -30.0, 40.1, True),
        ("expiration", 180.0, 250.0, True),
    ],
)
def test_a_breath_hold_whose_level_free_breathing_reaches_is_refused(kind, lower, upper, is_refused):
    wanted = hold(at(lower), at(upper), kind)
    for one in (wanted, joined(Join.AND, wanted, window(-50.0, 50.0)), joined(Join.OR, phase(0.0, 10.0), wanted)):
        limits = GateLimits(window=one)
        if is_refused:
            with pytest.raises(InvalidValueError, match=f"for an {kind} hold"):
                refuse_hold_in_free_breath(limits, RANGE)
        else:
            refuse_hold_in_free_breath(limits, RANGE)


@pytest.mark.parametrize("levels", [{}, {WHOLE: np.full(60, 3.0)}, {ABDOMEN: LEVELS[ABDOMEN]}])
def test_a_breath_hold_that_cannot_be_compared_with_free_breathing_is_refused(levels):
    with pytest.raises(CommandRefusedError, match="Train again"):
        refuse_hold_in_free_breath(GateLimits(window=hold(12.0, 20.0)), levels)


def test_windows_without_a_breath_hold_are_not_compared():
    for wanted in (window(-1.0, 3.0), phase(0.0, 10.0)):
        refuse_hold_in_free_breath(GateLimits(window=wanted), {})
