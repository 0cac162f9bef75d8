"""A window in per cent of the learned range: converted to mm or l once, or never inside."""

import math
from dataclasses import replace

import pytest

from engine.core.breath import WHOLE, SignalChoice
from engine.core.commands import Arm
from engine.core.errors import InvalidValueError
from engine.core.gate_state import GateState, HoldReason
from engine.core.signals import LearnedRange
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, JoinedWindow
from tests.support.gating.streams import LIMITS, Stream

PERCENT = AmplitudeWindow(lower=-10.0, upper=30.0, hysteresis=5.0, unit="percent")
RANGES = {WHOLE: LearnedRange(low=-2.0, high=8.0)}


def test_it_is_the_range_that_makes_mm_of_it():
    window = PERCENT.resolved(RANGES)
    assert (window.unit, window.lower, window.upper, window.hysteresis) == ("mm", -3.0, 1.0, 0.5)


def test_a_volume_becomes_litres():
    volume = SignalChoice(signal="volume")
    window = replace(PERCENT, choice=volume).resolved({volume: LearnedRange(low=0.0, high=0.5)})
    assert (window.unit, window.lower, window.upper) == ("l", pytest.approx(-0.05), pytest.approx(0.15))


@pytest.mark.parametrize(
    "ranges", [{}, {WHOLE: LearnedRange(low=1.0, high=1.0)}, {SignalChoice(signal="thorax"): RANGES[WHOLE]}]
)
def test_without_a_range_nothing_is_ever_inside(ranges):
    window = PERCENT.resolved(ranges)
    assert window.needs_ranges
    stream = Stream(replace(LIMITS, window=window))
    stream.feed()
    stream.step(Arm(operator="ann"))
    gate = stream.feed()
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.RANGE_UNKNOWN)


def test_every_condition_is_resolved_and_a_joined_window_needs_all_of_them():
    hold = BreathHoldWindow(level=PERCENT)
    chest = replace(PERCENT, choice=SignalChoice(signal="thorax"))
    window = JoinedWindow(conditions=(hold, chest))
    half = window.resolved(RANGES)
    assert not half.conditions[0].needs_ranges
    assert half.needs_ranges
    assert not window.resolved(RANGES | {chest.choice: RANGES[WHOLE]}).needs_ranges


def test_a_correction_moves_both_edges_of_its_own_signal_alone():
    window = AmplitudeWindow(lower=-1.0, upper=3.0)
    other = AmplitudeWindow(choice=SignalChoice(signal="thorax"), lower=-1.0, upper=3.0)
    moved = JoinedWindow(conditions=(window, other, BreathHoldWindow(level=window))).shifted(WHOLE, 0.5)
    assert [(leaf.lower, leaf.upper) for leaf in moved.conditions[:2]] == [(-0.5, 3.5), (-1.0, 3.0)]
    assert moved.conditions[2].level.lower == -0.5


def test_per_cent_are_not_moved():
    with pytest.raises(InvalidValueError, match="unit"):
        PERCENT.shifted(WHOLE, 1.0)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"lower": -100.1}, "lower_percent"),
        ({"upper": 301.0}, "upper_percent"),
        ({"upper": -10.0}, "upper_percent"),
        ({"hysteresis": 20.0}, "hysteresis_percent"),
        ({"upper": math.nan}, "upper_percent"),
        ({"unit": "l"}, "unit"),
        ({"unit": "inch"}, "unit"),
        ({"unit": "mm", "choice": SignalChoice(signal="volume")}, "unit"),
    ],
)
def test_a_window_that_is_none_is_refused_by_the_unit_s_own_field(changes, field):
    with pytest.raises(InvalidValueError) as refusal:
        replace(PERCENT, **changes)
    assert refusal.value.field == field
