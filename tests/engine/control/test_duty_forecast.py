"""Arming asks how much of the learned breaths lies in the window in use, and the status shows it."""

from dataclasses import replace

import pytest

from engine.control.arming import DutyForecast
from engine.control.session_state import SessionLimits
from engine.core.breath import WHOLE
from engine.core.clock import ManualClock
from engine.core.commands import Arm, CorrectBaseline
from engine.core.signals import LearnedRange
from engine.gating.active_window import SetWindow
from engine.gating.windows import (
    LEVEL_NOT_SET,
    AmplitudeWindow,
    BreathHoldWindow,
    JoinedWindow,
    PhaseWindow,
    Unit,
    amplitude_window,
)
from tests.support.control.loop_bench import Bench, RecordingPipeline, after, good
from tests.support.gating.streams import LEVEL_MM, LIMITS

ARM = Arm(operator="ann", head_direction=LIMITS.head_direction)
WIDE = amplitude_window(lower_mm=LEVEL_MM - 5.0, upper_mm=LEVEL_MM + 20.0)


class Asked:
    """A bench that is armed behind some frames; the learned breath goes from `LEVEL_MM` to 10 mm more."""

    def __init__(self, window, *, before=None, ranges=None, **limits):
        self.bench = Bench([], limits=replace(LIMITS, window=window, **limits))
        if ranges is not None:
            self.bench.pipeline.ranges = ranges
        commands = [ARM] if before is None else [before, ARM]
        self.bench.source.script += [good] * 3
        self.bench.source.script += [after(self.bench.ask(one)) for one in commands]
        self.bench.source.script += [good]
        self.bench.run()
        self.error = self.bench.answers[-1].exception()
        self.percent = self.bench.loop.status.predicted_duty_percent


def test_a_window_that_the_learned_breaths_never_leave_is_refused():
    asked = Asked(WIDE)
    assert "100 % of the learned breaths" in str(asked.error)
    assert "whole -3 to 22 mm" in str(asked.error)
    assert asked.percent == 100.0
    assert not asked.bench.beam.permits


def test_a_window_that_is_left_is_armed_and_its_share_shown():
    asked = Asked(amplitude_window(lower_mm=LEVEL_MM - 1.0, upper_mm=LEVEL_MM + 3.0))
    assert asked.error is None
    assert asked.percent == pytest.approx(30.0, abs=2.0)


def test_a_site_may_allow_more():
    assert Asked(WIDE, max_duty_percent=100.0).error is None


def test_a_window_in_per_cent_counts_as_it_was_resolved():
    wide = AmplitudeWindow(lower=-50.0, upper=150.0, unit=Unit.PERCENT)
    assert "100 % of the learned breaths" in str(Asked(wide).error)
    assert Asked(replace(wide, upper=30.0)).error is None


def test_a_baseline_correction_counts():
    edge = amplitude_window(lower_mm=LEVEL_MM - 20.0, upper_mm=LEVEL_MM + 8.5)
    assert Asked(edge).error is None
    moved = Asked(edge, before=CorrectBaseline(operator="ann", by=2.0))
    assert "100 % of the learned breaths" in str(moved.error)


def test_a_breath_hold_that_free_breathing_reaches_is_refused_by_the_engine():
    """The learned breath reaches from 2 to 12 mm."""
    asked = Asked(BreathHoldWindow(level=amplitude_window(lower_mm=-1.0, upper_mm=3.0)))
    assert "for an inspiration hold" in str(asked.error)
    assert not asked.bench.beam.permits


@pytest.mark.parametrize(
    ("changes", "is_refused"),
    [
        ({}, True),
        ({"reason": "  "}, True),
        ({"reason": "two fields", "is_person": False}, True),
        ({"reason": "two fields"}, False),
    ],
    ids=str,
)
def test_conditions_joined_by_or_are_armed_by_a_person_with_a_reason(changes, is_refused):
    low, high = (amplitude_window(lower_mm=lower, upper_mm=lower + 2.0) for lower in (2.0, 8.0))
    bench = Bench([good] * 3, limits=replace(LIMITS, window=JoinedWindow(conditions=(low, high), join="or")))
    bench.source.script += [after(bench.ask(replace(ARM, **changes))), *[good] * 8]
    bench.run()
    assert ("joins conditions by or" in str(bench.answers[-1].exception(timeout=0))) is is_refused
    assert bench.records()[-1].line_on is not is_refused


def test_a_breath_hold_is_not_armed_before_its_level_is_set():
    level = amplitude_window(lower_mm=10.0, upper_mm=20.0)
    unset = BreathHoldWindow(level=AmplitudeWindow(lower=0.0, upper=100.0, unit=Unit.PERCENT), is_level_set=False)
    asked = Asked(unset)
    assert str(asked.error) == LEVEL_NOT_SET
    assert not asked.bench.beam.permits
    times = {"dwell_ms": LIMITS.dwell_ms, "min_on_ms": 0.0, "min_off_ms": 0.0, "max_cycles_per_min": 120}
    wanted = BreathHoldWindow(level=level)
    asked = Asked(unset, before=SetWindow(operator="bob", window=wanted, **times))
    assert (asked.error, asked.bench.loop.status.view.window) == (None, wanted)


def test_a_phase_window_counts_by_its_phases_and_a_breath_hold_is_not_predicted():
    wide = Asked(PhaseWindow(from_percent=2.0, to_percent=98.0))
    assert "96 % of the learned breaths" in str(wide.error)
    hold = Asked(BreathHoldWindow(level=amplitude_window(lower_mm=10.0, upper_mm=20.0)))
    assert (hold.error, hold.percent) == (None, None)


def test_another_reference_is_another_prediction():
    bench, shown = Bench([], limits=replace(LIMITS, window=WIDE)), []
    pipeline = bench.pipeline

    def move():
        shown.append(bench.loop.status.predicted_duty_percent)
        pipeline.ranges = {WHOLE: LearnedRange(low=LEVEL_MM + 15.0, high=LEVEL_MM + 25.0)}
        pipeline.set_reference()

    bench.source.script += [good, good, after(move), good]
    bench.run()
    shown.append(bench.loop.status.predicted_duty_percent)
    assert shown == [100.0, pytest.approx(50.0, abs=2.0)]


def test_without_levels_of_the_training_the_gate_is_not_armed():
    asked = Asked(WIDE, ranges={})
    assert "Train again" in str(asked.error)
    assert asked.percent is None


def test_it_is_computed_once_for_a_model_a_reference_and_a_window():
    class Counting(RecordingPipeline):
        computed = 0

        def learned_levels(self, choices):
            self.computed += 1
            return super().learned_levels(choices)

    learner = Counting(ManualClock(0))
    forecast = DutyForecast(learner, SessionLimits(LIMITS))
    assert (forecast.percent, forecast.percent, forecast.ranges) == (
        forecast.percent,
        forecast.percent,
        forecast.ranges,
    )
    assert learner.computed == 1
    learner.zero_number += 1
    assert forecast.percent is not None
    assert learner.computed == 2
