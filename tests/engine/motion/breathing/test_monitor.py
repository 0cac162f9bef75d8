"""The monitor on breathing of which everything is known: phase, rate, level, and silence where it cannot tell."""

import math

import numpy as np
import pytest

from engine.core.breath import SignalChoice
from engine.motion.breathing import correct_baseline, follow_breathing, shifted, start_breathing, with_baseline
from tests.support.motion.breathing_traces import breath, follow, kinds, onsets, regular, times

pytestmark = pytest.mark.slow


def turn_error(reported_percent, true_percent):
    return abs((reported_percent - true_percent + 50.0) % 100.0 - 50.0)


@pytest.mark.parametrize("fps", [5.0, 10.0, 30.0, 60.0])
@pytest.mark.parametrize(("amplitude", "period"), [(4.0, 5.0), (10.0, 4.0), (16.0, 3.0), (12.0, 7.0)])
def test_the_phase_of_regular_breathing_is_true_to_a_few_per_cent(fps, amplitude, period):
    at, value, true = regular(60.0, amplitude=amplitude, period=period, fps=fps)
    reported = follow(at, value)
    late = [(one, phase) for one, phase, seconds in zip(reported, true, at, strict=True) if seconds > 6.0 * period]
    assert all(one.phase_percent is not None for one, _ in late)
    errors = [turn_error(one.phase_percent, phase) for one, phase in late]
    assert np.mean(errors) < 4.0
    assert np.percentile(errors, 95) < 10.0
    assert min(one.phase_confidence for one, _ in late[20:]) > 0.6


def test_the_phase_never_goes_back_within_a_breath():
    at, value, _ = regular(80.0, noise=0.3)
    phases = [one.phase_percent for one in follow(at, value) if one.phase_percent is not None]
    steps = np.diff(phases)
    back = steps[steps < 0.0]
    assert len(phases) > 1800
    assert np.all(back < -60.0)  # only from one breath to the next
    assert len(back) == pytest.approx(len(phases) / 30.0 / 4.0, abs=1.5)


def test_rate_depth_and_level_are_reported_in_the_signals_own_unit():
    at, value, _ = regular(40.0, amplitude=10.0, period=4.0)
    last = follow(at, value + 3.0)[-1]
    assert last.rate_per_min == pytest.approx(15.0, rel=0.02)
    assert last.rate_confidence > 0.8
    assert last.amplitude == pytest.approx(10.0, rel=0.06)
    assert last.baseline == pytest.approx(3.0, abs=0.3)
    assert last.drift == pytest.approx(0.0, abs=0.2)
    assert last.drift_per_s == pytest.approx(0.0, abs=0.03)
    assert last.regularity > 0.9


def test_a_volume_is_reported_in_litres():
    at, value, _ = regular(40.0, amplitude=6.0, period=4.0)
    choice = SignalChoice(signal="volume")
    last = follow(at, 0.1 * value + 2.0, choice)[-1]
    assert last.signal == choice
    assert last.amplitude == pytest.approx(0.6, rel=0.06)
    assert last.baseline == pytest.approx(2.0, abs=0.03)
    assert last.phase_percent is not None


def test_nothing_is_reported_before_breaths_were_seen_except_the_reason():
    at, value, _ = regular(3.0)
    last = follow(at, value)[-1]
    assert (last.phase_percent, last.rate_per_min, last.note) == (None, None, "too little seen yet")


@pytest.mark.parametrize("what", ["constant", "noise", "heart"])
def test_a_doll_does_not_breathe(what):
    at = times(120.0)
    value = {
        "constant": 0.0 * at,
        "noise": np.random.default_rng(1).normal(0.0, 0.1, len(at)),
        "heart": 0.15 * np.sin(2.0 * np.pi * 1.1 * at) + np.random.default_rng(1).normal(0.0, 0.1, len(at)),
    }[what]
    reported = follow(at, value)
    assert all(one.phase_percent is None and not one.events for one in reported)


@pytest.mark.parametrize("way", ["missing", "nan"])
def test_after_a_gap_no_phase_is_reported_until_breaths_are_found_again(way):
    at, value, _ = regular(80.0)
    is_gap = (at >= 40.0) & (at < 41.0)
    if way == "nan":
        reported = follow(at, np.where(is_gap, math.nan, value))
    else:
        at = at[~is_gap]
        reported = follow(at, value[~is_gap])
    after = {round(seconds, 2): one for seconds, one in zip(at, reported, strict=True)}
    assert after[39.9].phase_percent is not None
    assert after[41.5].phase_percent is None
    assert after[41.5].note == "not measured for a moment"
    assert after[50.0].phase_percent is None  # one breath is not enough
    assert after[58.0].phase_percent is not None
    assert onsets(reported, at) == []


def test_the_last_end_of_exhale_is_known_with_its_time_and_drift_also_after_a_gap():
    at, value, _ = regular(80.0, period=4.0)
    is_gap = (at >= 41.0) & (at < 42.5)
    moved = np.where(at > 42.0, value - 3.0, value)
    reported = follow(at[~is_gap], moved[~is_gap])
    after = list(zip(at[~is_gap], reported, strict=True))
    before = [one for seconds, one in after if 30.0 < seconds < 41.0]
    assert all(0.0 <= seconds - one.exhale_us / 1e6 < 5.5 for seconds, one in after if 30.0 < seconds < 41.0)
    assert max(abs(one.exhale_drift) for one in before) < 0.3
    behind = [(seconds, one) for seconds, one in after if seconds >= 42.5]
    assert behind[0][1].exhale_us == before[-1].exhale_us
    seen_s, seen = next((seconds, one) for seconds, one in behind if one.exhale_us > 42.5e6)
    assert seen_s < 42.5 + 2.0 * 4.0
    assert seen.exhale_drift == pytest.approx(-3.0, abs=0.4)


@pytest.mark.parametrize("lower_by", [0.0, 3.0])
def test_an_exhale_that_lies_lower_than_the_last_counts_before_its_end(lower_by):
    """The patient sinks during an exhale: the next inhale has not begun yet when its drift is known."""
    at, value, phase = regular(60.0, period=4.0)
    sinks_s = at[np.flatnonzero((at > 40.0) & (phase >= 25.0) & (phase < 30.0))[0]]
    reported = follow(at, value - lower_by * np.clip(at - sinks_s, 0.0, 0.5) / 0.5)
    rises_s = at[np.flatnonzero((at > sinks_s) & (phase > 70.0))[0]]
    seen = [one for seconds, one in zip(at, reported, strict=True) if sinks_s < seconds < rises_s]
    assert {one.exhale_us for one in seen} == {seen[0].exhale_us}
    assert min(one.exhale_drift for one in seen) == pytest.approx(-lower_by, abs=0.4)
    assert max(abs(one.drift) for one in seen) < 0.4  # the last complete exhale


def test_a_frame_or_two_that_are_lost_cost_nothing():
    at, value, true = regular(60.0)
    kept = np.ones(len(at), dtype=bool)
    kept[1200:1203] = kept[1500:1501] = False
    reported = follow(at[kept], value[kept])
    late = [(one, phase) for one, phase, seconds in zip(reported, true[kept], at[kept], strict=True) if seconds > 30.0]
    assert all(one.phase_percent is not None for one, _ in late)


def test_quantised_breathing_is_followed_as_well():
    at, value, true = regular(60.0, amplitude=8.0)
    reported = follow(at, np.round(value / 0.5) * 0.5)
    errors = [turn_error(one.phase_percent, phase) for one, phase in list(zip(reported, true, strict=True))[900:]]
    assert np.mean(errors) < 4.0
    assert onsets(reported, at) == []


@pytest.mark.parametrize("share", [0.15, 0.55, 0.9], ids=["in", "out", "rest"])
def test_another_reference_is_no_event_and_keeps_the_phase(share):
    at, value, _ = regular(60.0)
    cut = round((40.0 + 4.0 * share) * 30)
    state = start_breathing(SignalChoice())
    for seconds, one in zip(at[:cut].tolist(), value[:cut].tolist(), strict=True):
        state = follow_breathing(state, seconds, one)
    state = shifted(state, -25.0)
    reported = follow(at[cut:], value[cut:] - 25.0, state=state)
    assert all(one.phase_percent is not None and not one.events for one in reported)
    assert reported[-1].drift == pytest.approx(0.0, abs=0.2)
    assert reported[-1].baseline == pytest.approx(-25.0, abs=0.3)


def test_a_reference_that_is_set_twice_in_a_second_is_no_cough():
    at, value, _ = regular(44.0)
    state, reported = start_breathing(SignalChoice()), []
    for seconds, one in zip(at.tolist(), value.tolist(), strict=True):
        for moment, by in ((40.0, -25.0), (40.5, 25.0)):
            state = shifted(state, by) if abs(seconds - moment) < 0.01 else state
        zero = 25.0 if 39.99 < seconds < 40.49 else 0.0
        state = follow_breathing(state, seconds, one - zero)
        reported.append(state.breath)
    assert onsets(reported, at) == []


def test_an_unannounced_shift_is_detected():
    at, value, _ = regular(80.0)
    reported = follow(at, np.where(at > 40.0, value - 6.0, value))
    assert reported[-1].drift == pytest.approx(-6.0, abs=0.3)
    assert "drift" in {kind for kind, _ in onsets(reported, at)}


def test_a_baseline_that_a_person_confirmed_ends_the_drift():
    at, value, _ = regular(80.0)
    state = start_breathing(SignalChoice())
    for seconds, one in zip(at.tolist(), (value + np.clip(0.2 * (at - 30.0), 0.0, 4.0)).tolist(), strict=True):
        state = follow_breathing(state, seconds, one)
    assert kinds(state.breath) == {"drift"}
    assert state.breath.drift == pytest.approx(4.0, abs=0.3)
    confirmed = with_baseline(state, state.breath.baseline)
    assert kinds(confirmed.breath) == set()
    assert confirmed.breath.drift == pytest.approx(0.0, abs=0.01)
    later, more, _ = regular(120.0)
    reported = follow(later[2400:], more[2400:] + 4.0, state=confirmed)
    assert onsets(reported, later[2400:]) == []


def test_a_correction_counts_from_where_the_level_was_learned_and_can_be_taken_back():
    at, value, _ = regular(40.0)
    state = start_breathing(SignalChoice())
    for seconds, one in zip(at.tolist(), value.tolist(), strict=True):
        state = follow_breathing(state, seconds, one)
    drift = state.breath.drift
    twice = correct_baseline(correct_baseline(state, 2.0), 2.0)
    assert twice.breath.drift == pytest.approx(drift - 2.0)
    assert correct_baseline(twice, 0.0).breath.drift == pytest.approx(drift)


def test_what_was_not_measured_is_reported_as_such():
    at, value, _ = regular(40.0)
    value[-1] = math.nan
    last = follow(at, value)[-1]
    assert (last.phase_percent, last.events, last.note) == (None, (), "not measured")


def test_breath_shapes_of_the_tests_are_what_they_say():
    assert breath(0.0) == pytest.approx(1.0)
    assert breath(0.6) == pytest.approx(0.0, abs=1e-6)


def test_the_phase_waits_for_a_breath_that_is_late_and_is_given_up_before_long():
    at = times(80.0)
    pause = np.clip(at - 50.8, 0.0, 3.0)  # at 70 %, at rest
    value = 10.0 * breath((at - pause) / 4.0) + np.random.default_rng(0).normal(0.0, 0.05, len(at))
    waiting = [one for seconds, one in zip(at, follow(at, value), strict=True) if 51.0 < seconds < 53.7]
    reported = [one for one in waiting if one.phase_percent is not None]
    assert reported
    assert all(60.0 < one.phase_percent < 85.0 for one in reported)
    assert waiting[-1].phase_percent is None
    assert waiting[-1].note == "the breath is late"
    assert reported[-1].phase_confidence < 0.3 < reported[0].phase_confidence


def test_a_cycle_that_is_longer_by_a_quarter_does_not_run_ahead():
    at = times(60.0)
    stretched = np.where(at < 40.0, at / 4.0, 10.0 + (at - 40.0) / 5.0)
    value = 10.0 * breath(stretched) + np.random.default_rng(0).normal(0.0, 0.05, len(at))
    reported = follow(at, value)
    errors = [
        turn_error(one.phase_percent, 100.0 * (true % 1.0))
        for one, true, seconds in zip(reported, stretched, at, strict=True)
        if 40.0 < seconds < 55.0 and one.phase_percent is not None
    ]
    assert len(errors) > 400
    assert max(errors) < 22.0


def test_a_signal_that_begins_on_its_way_down_is_no_odd_first_breath():
    at, value, _ = regular(40.0)
    state = start_breathing(SignalChoice())
    for seconds, one in zip(at[36:].tolist(), value[36:].tolist(), strict=True):  # 30 % after the end of inhale
        state = follow_breathing(state, seconds, one)
    assert state.history.cycles
    assert all(cycle.period_s == pytest.approx(4.0, abs=0.3) for cycle in state.history.cycles)
    assert state.breath.regularity > 0.95
