"""A session's window is set again while the gate is disarmed: other numbers, the same signals."""

from dataclasses import replace

import pytest

from engine.core.breath import WHOLE, GateSignal, SignalChoice
from engine.core.commands import Arm, CorrectBaseline, SetReference
from engine.core.errors import CommandRefusedError, InvalidValueError
from engine.core.gate_state import GateState
from engine.core.signals import LearnedRange
from engine.gating.active_window import SetWindow, checked_change
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, JoinedWindow, PhaseWindow, Unit, amplitude_window
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import LEVEL_MM, LIMITS

ARM = Arm(operator="ann", head_direction=LIMITS.head_direction)
WINDOW = amplitude_window(lower_mm=-1.0, upper_mm=3.0)
AROUND = amplitude_window(lower_mm=LEVEL_MM - 0.5, upper_mm=LEVEL_MM + 0.5)
BESIDE = amplitude_window(lower_mm=LEVEL_MM + 1.0, upper_mm=LEVEL_MM + 4.0)


def set_to(window, **times):
    usual = {"dwell_ms": LIMITS.dwell_ms, "min_on_ms": 0.0, "min_off_ms": 0.0, "max_cycles_per_min": 120}
    return SetWindow(operator="bob", window=window, **{**usual, **times})


def after_commands(*commands, window=WINDOW, frames=8, ranges=None, **limits):
    """A bench that carried out the commands, each behind a frame, and then saw some frames."""
    bench = Bench([good] * 3, limits=replace(LIMITS, window=window, **limits))
    if ranges is not None:
        bench.pipeline.ranges = ranges
    bench.source.script += [after(bench.ask(one)) for one in commands]
    bench.source.script += [good] * frames
    bench.run()
    return bench


def refusal(bench):
    return bench.answers[-1].exception(timeout=0)


@pytest.mark.parametrize(("window", "is_on"), [(AROUND, True), (BESIDE, False)])
def test_the_gate_decides_by_the_window_that_was_set(window, is_on):
    bench = after_commands(set_to(window), ARM)
    assert bench.records()[-1].line_on is is_on
    assert bench.loop.status.view.window == window


def test_both_windows_and_the_person_are_recorded_though_the_gate_was_disarmed():
    change = after_commands(set_to(BESIDE)).transitions()[0]
    assert (change.to_state, change.operator) == (GateState.DISARMED, "bob")
    assert change.detail == "the window was whole -1 to 3 mm and is whole 3 to 6 mm"


def test_an_armed_gate_refuses_another_window_and_goes_on():
    bench = after_commands(ARM, set_to(BESIDE))
    assert isinstance(refusal(bench), CommandRefusedError)
    assert "disarm" in str(refusal(bench))
    assert bench.records()[-1].line_on
    assert bench.loop.status.view.window == WINDOW


@pytest.mark.parametrize(
    "window",
    [
        replace(WINDOW, choice=SignalChoice(signal=GateSignal.THORAX)),
        PhaseWindow(from_percent=10.0, to_percent=60.0),
        BreathHoldWindow(level=WINDOW),
        JoinedWindow(conditions=(WINDOW, PhaseWindow(from_percent=10.0, to_percent=60.0))),
    ],
)
def test_other_signals_and_kinds_of_conditions_are_refused_by_name(window):
    bench = after_commands(set_to(window))
    assert isinstance(refusal(bench), InvalidValueError)
    assert (refusal(bench).field, "another session" in refusal(bench).bound) == ("window", True)
    assert bench.loop.status.view.window == WINDOW
    assert not any("the window was" in one.detail for one in bench.transitions())


def test_another_join_or_hold_is_refused():
    hold = BreathHoldWindow(level=WINDOW)
    assert refusal(after_commands(set_to(replace(hold, kind="expiration")), window=hold)) is not None
    both = JoinedWindow(conditions=(WINDOW, PhaseWindow(from_percent=10.0, to_percent=60.0)))
    assert refusal(after_commands(set_to(replace(both, join="or")), window=both)) is not None
    assert refusal(after_commands(set_to(replace(both, conditions=(AROUND, both.conditions[1]))), window=both)) is None


def test_per_cent_are_converted_at_once_and_only_again_for_another_reference():
    percent = AmplitudeWindow(lower=0.0, upper=30.0, unit=Unit.PERCENT)
    ranges = {WHOLE: LearnedRange(low=LEVEL_MM - 1.0, high=LEVEL_MM + 9.0)}
    bench = after_commands(set_to(percent), ARM, ranges=ranges)
    window = bench.loop.status.view.window
    assert (window.lower, window.upper, window.unit) == (LEVEL_MM - 1.0, LEVEL_MM + 2.0, Unit.MM)
    assert bench.records()[-1].line_on
    moved = {WHOLE: LearnedRange(low=LEVEL_MM + 2.0, high=LEVEL_MM + 12.0)}
    bench = after_commands(set_to(percent), window=percent, ranges=moved)
    assert bench.loop.status.view.window.lower == LEVEL_MM + 2.0


def test_every_time_of_the_command_becomes_a_limit_and_no_other_limit_changes():
    times = {"dwell_ms": 210.0, "min_on_ms": 350.0, "min_off_ms": 410.0, "max_cycles_per_min": 17}
    percent = AmplitudeWindow(lower=0.0, upper=30.0, unit=Unit.PERCENT)
    for wanted in (BESIDE, percent):
        change = checked_change(WINDOW, set_to(wanted, **times), LIMITS, {})
        assert change.limits == replace(LIMITS, window=wanted, **times)
        assert (change.window.requested, change.window.window) == (wanted, wanted)


def test_a_baseline_correction_ends_with_another_window():
    bench = after_commands(CorrectBaseline(operator="bob", by=1.5, reason="relaxed", may_exceed=True), set_to(AROUND))
    assert bench.loop.status.view.window == AROUND
    assert bench.pipeline.calls[-1] == "correct whole 0"
    bench = after_commands(set_to(AROUND), SetReference(operator="bob"))
    assert bench.loop.status.view.window == AROUND


@pytest.mark.parametrize(
    ("command", "field"),
    [
        (set_to(BESIDE), "window.upper_mm"),
        (set_to(replace(WINDOW, lower=-4.5)), "window.lower_mm"),
        (set_to(WINDOW, dwell_ms=-1.0), "dwell_ms"),
        (set_to(WINDOW, max_cycles_per_min=0), "max_cycles_per_min"),
        (set_to(WINDOW, min_off_ms=float("nan")), "min_off_ms"),
    ],
)
def test_a_window_beyond_the_site_s_limits_is_refused_and_changes_nothing(command, field):
    bench = after_commands(command, window_lower_mm=-4.0, window_upper_mm=4.0)
    assert refusal(bench).field == field
    assert bench.loop.status.view.window == WINDOW
    assert not any("the window was" in one.detail for one in bench.transitions())


def test_per_cent_beyond_the_site_s_limits_are_refused_as_converted():
    ranges = {WHOLE: LearnedRange(low=0.0, high=10.0)}
    percent = AmplitudeWindow(lower=0.0, upper=60.0, unit=Unit.PERCENT)
    error = refusal(after_commands(set_to(percent), ranges=ranges, window_upper_mm=4.0))
    assert (error.field, error.value) == ("window.upper_mm", "6.0")


def test_the_times_of_the_window_are_those_that_were_set():
    quick = after_commands(set_to(AROUND, dwell_ms=100.0), ARM).records()
    slow = after_commands(set_to(AROUND, dwell_ms=10_000.0), ARM).records()
    assert (quick[-1].line_on, slow[-1].line_on) == (True, False)


def test_the_predicted_duty_cycle_is_that_of_the_window_that_was_set():
    wide = amplitude_window(lower_mm=LEVEL_MM - 5.0, upper_mm=LEVEL_MM + 20.0)
    bench = after_commands(set_to(wide), ARM)
    assert "100 % of the learned breaths" in str(refusal(bench))
    assert bench.loop.status.predicted_duty_percent == 100.0


def test_other_conditions_are_refused_with_those_of_the_session_and_what_they_need():
    phase = PhaseWindow(from_percent=30.0, to_percent=70.0)
    with pytest.raises(InvalidValueError) as refusal:
        checked_change(WINDOW, set_to(phase), LIMITS, {})
    assert refusal.value.field == "window"
    assert refusal.value.bound == (
        "in the session's own conditions (whole -1 to 3 mm) with other numbers: other signals or kinds of conditions "
        "need another session"
    )
