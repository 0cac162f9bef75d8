"""A phase window alone, and a body that is elsewhere: how long the beam would be on, against the true level.

Signals are without noise, so that what a check misses is what it allows, not luck. The beam counts as on from the
fourth frame inside, as behind a dwell of three periods.
"""

import math
from dataclasses import dataclass

import pytest

from engine.core.breath import WHOLE, SignalChoice
from engine.core.frames import Motion
from engine.gating.windows import PhaseWindow, WindowInput, initial_states
from engine.motion.breathing import correct_baseline, follow_breathing, start_breathing
from tests.support.gating.streams import motion_of

pytestmark = pytest.mark.slow

FPS = 30
DEPTH_MM = 10.0
INHALE = PhaseWindow(from_percent=85.0, to_percent=15.0)
EXHALE = PhaseWindow(from_percent=35.0, to_percent=65.0)
ELSEWHERE = {INHALE: lambda mm: mm < 7.9, EXHALE: lambda mm: mm > 2.1}
"""In regular breathing the one window lies over 7.94 mm, the other under 2.06."""
BLINK_S = 0.2
MOTION: Motion = motion_of()


def level(phase):
    return DEPTH_MM * (0.5 + 0.5 * math.cos(2.0 * math.pi * phase))


@dataclass
class On:
    """When the beam would be on [s], the levels then [mm], and all that was reported."""

    at_s: list
    levels: list
    reported: list

    def seconds(self, is_bad, from_s, to_s=math.inf):
        pairs = zip(self.at_s, self.levels, strict=True)
        return sum(from_s <= at_s < to_s and is_bad(mm) for at_s, mm in pairs) / FPS


def gated(signal, seconds, window):
    state, states, inside, on = start_breathing(WHOLE), initial_states(window), 0, On([], [], [])
    for index in range(round(seconds * FPS)):
        now_s = index / FPS
        mm = signal(now_s)
        state = follow_breathing(state, now_s, mm)
        verdict = window.judge(WindowInput(MOTION, (state.breath,), round(now_s * 1e6)), states)
        states = verdict.states
        inside = inside + 1 if verdict.is_inside else 0
        on.reported.append(state.breath)
        if inside > 3:
            on.at_s.append(now_s)
            on.levels.append(mm)
    return on


def assert_was_on_before(on, change_s):
    """The beam comes in every breath before the change: else the test proves nothing."""
    assert on.seconds(lambda _: True, change_s - 20.0, change_s) > 20.0 * 0.04


@pytest.mark.parametrize(
    ("window", "share"),
    [(INHALE, 0.7), (INHALE, 0.75), (INHALE, 0.78), (INHALE, 0.8), (EXHALE, 0.2), (EXHALE, 0.25), (EXHALE, 0.3)],
)
def test_a_breath_that_stops_takes_the_beam_off_within_a_blink(window, share):
    stop_s = 60.0 + 4.0 * share
    on = gated(lambda now_s: level(min(now_s, stop_s) / 4.0), stop_s + 12.0, window)
    assert_was_on_before(on, 60.0)
    assert on.seconds(ELSEWHERE[window], stop_s) <= BLINK_S


def test_a_breath_that_is_held_at_its_top_is_not_on_its_way_out():
    way_out = PhaseWindow(from_percent=15.0, to_percent=30.0)
    on = gated(lambda now_s: level(min(now_s, 60.0) / 4.0), 66.0, way_out)
    assert_was_on_before(on, 60.0)
    assert on.seconds(lambda mm: mm > 8.5, 60.0) <= BLINK_S


@pytest.mark.parametrize(("before_s", "after_s"), [(4.0, 8.0), (3.0, 6.0), (8.0, 3.0), (4.0, 2.5)])
@pytest.mark.parametrize("window", [INHALE, EXHALE], ids=["inhale", "exhale"])
def test_a_breath_of_another_length_has_the_beam_on_elsewhere_for_a_blink_in_all(window, before_s, after_s):
    change_s = 15.0 * before_s
    on = gated(
        lambda now_s: level(min(now_s, change_s) / before_s + max(now_s - change_s, 0.0) / after_s),
        change_s + 60.0,
        window,
    )
    assert_was_on_before(on, change_s)
    assert on.seconds(ELSEWHERE[window], change_s) <= BLINK_S
    assert on.reported[-1].phase_percent is not None  # a new habit is learned


def lifted(by_mm, begin_s, within_s):
    return lambda now_s: level(now_s / 4.0) + by_mm * min(max((now_s - begin_s) / within_s, 0.0), 1.0)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.45, 0.6, 0.8])
def test_a_body_that_is_lifted_has_no_phase_until_a_person_confirms(share):
    begin_s = 60.0 + 4.0 * share
    on = gated(lifted(10.0, begin_s, 0.5), 150.0, EXHALE)
    assert_was_on_before(on, 60.0)
    assert on.seconds(ELSEWHERE[EXHALE], begin_s) <= BLINK_S
    assert (on.reported[-1].phase_percent, on.reported[-1].phase_confidence) == (None, 0.0)
    assert on.reported[-1].note == "the baseline has drifted"


def test_a_body_that_is_lifted_on_its_way_in_is_no_sigh():
    on = gated(lifted(10.0, 63.0, 0.5), 68.0, INHALE)
    assert_was_on_before(on, 60.0)
    assert on.seconds(lambda mm: mm > 18.5, 63.0) <= BLINK_S


def test_a_body_that_sinks_has_no_phase_either():
    on = gated(lifted(-10.0, 60.8, 0.5), 100.0, INHALE)
    assert_was_on_before(on, 60.0)
    assert on.seconds(ELSEWHERE[INHALE], 60.8) <= BLINK_S
    assert on.reported[-1].note == "the baseline has drifted"


@pytest.mark.parametrize("way", [1.0, -1.0], ids=["up", "down"])
def test_a_body_that_drifts_is_not_treated_beyond_a_third_of_its_breath(way):
    rate_mm_s = 20.0 / 120.0
    on = gated(lifted(way * 20.0, 60.0, 120.0), 200.0, EXHALE)
    assert_was_on_before(on, 60.0)
    # The level is known once a breath.
    beyond_s = 60.0 + DEPTH_MM / 3.0 / rate_mm_s + 4.0
    assert on.seconds(lambda _: True, beyond_s) == 0.0
    assert on.seconds(lambda _: True, 64.0, beyond_s - 8.0) > 1.0


def test_a_step_within_the_bound_costs_a_breath_or_two_and_no_more():
    on = gated(lifted(2.5, 61.6, 0.5), 100.0, EXHALE)
    assert "the level does not match the phase" in {one.note for one in on.reported}
    assert on.seconds(lambda _: True, 80.0) > 20.0 * 0.15


@pytest.mark.parametrize(("by_mm", "is_reported"), [(1.9, True), (2.4, False)])
def test_a_shallow_breath_may_drift_by_two_millimetres(by_mm, is_reported):
    signal = lifted(by_mm, 60.0, 60.0)
    on = gated(lambda now_s: signal(now_s) - 0.6 * level(now_s / 4.0), 140.0, EXHALE)
    assert (on.reported[-1].phase_percent is not None) is is_reported


def test_no_breath_is_so_deep_that_it_may_drift_by_more_than_five_millimetres():
    signal = lifted(5.4, 60.0, 60.0)
    on = gated(lambda now_s: signal(now_s) + level(now_s / 4.0), 140.0, EXHALE)
    assert on.reported[-1].note == "the baseline has drifted"


def test_a_correction_that_a_person_confirms_brings_the_phase_back_and_its_end_takes_it_again():
    state, signal = start_breathing(WHOLE), lifted(4.0, 60.0, 30.0)
    for index in range(110 * FPS):
        state = follow_breathing(state, index / FPS, signal(index / FPS))
    assert state.breath.note == "the baseline has drifted"
    confirmed = correct_baseline(state, 4.0)
    assert confirmed.breath.phase_percent is not None
    assert confirmed.breath.phase_confidence > 0.6
    assert correct_baseline(confirmed, 0.0).breath.note == "the baseline has drifted"


def test_a_clock_that_goes_back_keeps_what_a_person_has_confirmed():
    state = start_breathing(WHOLE)
    for index in range(40 * FPS):
        state = follow_breathing(state, index / FPS, level(index / FPS / 4.0))
    state = follow_breathing(correct_baseline(state, 4.0), 1.0, 0.0)
    assert state.history.correction == 4.0


@pytest.mark.parametrize("times", [1.5, 0.7])
def test_a_breath_half_as_deep_again_or_a_third_shallower_keeps_its_phase_until_it_is_known_to_be_odd(times):
    def signal(now_s):
        return level(now_s / 4.0) * (times if 62.0 <= now_s < 66.0 else 1.0)  # from one end of exhale to the next

    on = gated(signal, 72.0, INHALE)
    assert all(one.phase_percent is not None for one in on.reported[61 * FPS : round(64.6 * FPS)])
    assert "the level does not match the phase" not in {one.note for one in on.reported}


def test_the_body_of_a_volume_is_judged_in_litres():
    choice = SignalChoice(signal="volume")
    state, signal = start_breathing(choice), lifted(10.0, 60.8, 0.5)
    for index in range(61 * FPS + 45):
        state = follow_breathing(state, index / FPS, 0.1 * signal(index / FPS))
        if index < 60 * FPS and index > 30 * FPS:
            assert state.breath.phase_percent is not None
    assert state.breath.note == "the level does not match the phase"
