"""Each event, built by construction: found, with its kind, in time, and over when it is over."""

import numpy as np
import pytest

from engine.core.breath import SignalChoice
from engine.motion.breathing import follow_breathing, start_breathing
from lab.phantom.breathing import time_grid
from lab.phantom.builds import find_build
from lab.phantom.episodes import lay_out_course
from tests.support.motion.breathing_traces import breath, follow, kinds, onsets, regular, times

pytestmark = pytest.mark.slow

SECONDS = 100.0


def spikes(at, start, count, height, width=0.3, pause=0.15):
    value = np.zeros(len(at))
    for number in range(count):
        share = np.clip((at - start - number * (width + pause)) / width, 0.0, 1.0)
        value += height * (0.5 - 0.5 * np.cos(2.0 * np.pi * share))
    return value


def first(reported, at, kind):
    return next((seconds for found, seconds in onsets(reported, at) if found == kind), None)


def course(kind, volunteer, seed, fps=30.0, **wanted):
    rng = np.random.default_rng([seed, volunteer])
    grid = time_grid(SECONDS)
    laid = lay_out_course(find_build(volunteer), grid, SECONDS, rng, kinds=(kind,), quiet_s=28.0, **wanted)
    at = times(SECONDS, fps)
    value = np.interp(at, grid, 0.5 * (laid.signals.abdomen_mm + laid.signals.thorax_mm))
    return at, value + rng.normal(0.0, 0.1, len(at)), laid.episodes[0]


@pytest.mark.parametrize("fps", [10.0, 30.0, 60.0])
@pytest.mark.parametrize(("count", "height", "width"), [(2, 5.0, 0.4), (3, 8.0, 0.3), (4, 20.0, 0.2)])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_a_cough_is_reported_within_a_second_and_over_two_seconds_after(fps, count, height, width, share):
    at, value, _ = regular(80.0, fps=fps)
    start = 40.0 + 4.0 * share
    reported = follow(at, value + spikes(at, start, count, height, width))
    found = first(reported, at, "cough")
    assert start < found < start + 1.0
    by_time = dict(zip(np.round(at, 3), reported, strict=True))
    during = by_time[at[np.searchsorted(at, found + 0.1)].round(3)]
    assert (during.phase_percent, during.note) == (None, "cough")
    assert during.events[-1].start_us == pytest.approx(start * 1e6, abs=0.4e6)
    end = start + count * (width + 0.15)
    assert all("cough" not in kinds(one) for seconds, one in by_time.items() if seconds > end + 2.0)
    assert by_time[at[-1].round(3)].phase_percent is not None


def test_more_bends_make_a_cough_surer():
    at, value, _ = regular(60.0)
    sure = {
        count: max(event.confidence for one in follow(at, value + spikes(at, 40.0, count, 8.0)) for event in one.events)
        for count in (2, 4)
    }
    assert 0.5 < sure[2] < sure[4] <= 1.0


@pytest.mark.parametrize("kind", ["sigh", "apnoea", "talking", "irregular", "cough"])
@pytest.mark.parametrize("volunteer", [1, 5, 9, 10])
def test_labelled_events_are_reported_by_their_name(kind, volunteer):
    at, value, episode = course(kind, volunteer, seed=50)
    found = first(follow(at, value), at, kind)
    assert found is not None
    assert episode.start_s <= found <= episode.end_s + 3.0


@pytest.mark.parametrize("volunteer", [2, 9, 10])
@pytest.mark.parametrize("rate", [0.1, 0.2, 0.4, 0.74, -0.1, -0.2, -0.4, -0.74])
def test_drift_is_noticed_within_three_cycles(volunteer, rate):
    at, value, episode = course("drift", volunteer, seed=51, drift_mm_s=rate)
    reported = follow(at, value)
    found = first(reported, at, "drift")
    assert episode.start_s < found < episode.start_s + 3.0 * find_build(volunteer).period_s
    later = reported[np.searchsorted(at, found + 6.0)]
    assert np.sign(later.drift) == np.sign(rate)
    assert {kind for kind, _ in onsets(reported, at)} == {"drift"}  # and breathing that drifts is regular all the same
    assert later.drift_per_s == pytest.approx(rate, rel=0.6)


def test_an_apnoea_has_no_phase_and_no_rate_and_is_over_with_the_next_breath():
    at = times(100.0)
    phase = np.where(at < 50.4, at, np.where(at < 64.4, 50.4, at - 14.0)) / 4.0  # rests at 60 %, the end of exhale
    value = 10.0 * breath(phase) + np.random.default_rng(0).normal(0.0, 0.1, len(at))
    reported = follow(at, value)
    found = first(reported, at, "apnoea")
    assert 54.0 < found < 57.0
    during = reported[np.searchsorted(at, 60.0)]
    assert (during.phase_percent, during.rate_per_min, during.note) == (None, None, "apnoea")
    assert "apnoea" not in kinds(reported[np.searchsorted(at, 67.0)])
    assert reported[-1].phase_percent is not None


@pytest.mark.parametrize("rate", [0.7, -0.7])
def test_a_signal_that_moves_on_without_a_breath_is_no_cycle_until_breaths_come_back(rate):
    """It neither rests, as in an apnoea, nor turns."""
    at = times(100.0)
    slides = np.clip(at - 50.4, 0.0, 20.0)
    phase = np.where(at < 50.4, at, np.where(at < 70.4, 50.4, at - 20.0)) / 4.0
    value = 10.0 * breath(phase) + rate * slides + np.random.default_rng(0).normal(0.0, 0.1, len(at))
    reported = follow(at, value)
    assert 50.4 + 2.0 * 4.0 < first(reported, at, "no_cycle") < 50.4 + 3.5 * 4.0
    assert "no_cycle" in kinds(reported[np.searchsorted(at, 68.0)])
    assert "no_cycle" not in kinds(reported[np.searchsorted(at, 76.0)])


@pytest.mark.parametrize("height", [0.7, 1.3])
def test_a_breath_that_is_held_above_exhale_is_no_apnoea_and_has_no_phase(height):
    at = times(100.0)
    held = (at >= 51.0) & (at < 70.0)
    value = np.where(held, 10.0 * height, 10.0 * breath(at / 4.0))
    value += np.random.default_rng(0).normal(0.0, 0.1, len(at))
    reported = follow(at, value)
    during = [one for one, inside in zip(reported, held & (at > 57.5), strict=True) if inside]
    assert all(one.phase_percent is None for one in during)
    assert during[-1].note == "held"
    assert "apnoea" not in {kind for kind, _ in onsets(reported, at)}
    assert "drift" not in {kind for kind, _ in onsets(reported, at)}


def test_regular_breathing_for_half_an_hour_has_no_event_at_all():
    at, value, _ = regular(1800.0, amplitude=8.0, period=4.3, noise=0.12)
    wander = 0.1 * np.sin(2.0 * np.pi * at / 47.0)
    assert onsets(follow(at, value + wander), at) == []


def test_a_slow_rest_at_the_end_of_exhale_is_no_apnoea():
    at = times(120.0)
    resting = (at % 8.0) / 8.0
    value = 12.0 * np.where(resting < 0.5, np.sin(np.pi * resting / 0.5) ** 2, 0.0)
    assert onsets(follow(at, value + np.random.default_rng(0).normal(0.0, 0.1, len(at))), at) == []


def test_a_patient_who_is_moved_within_a_second_does_not_cough():
    at, value, _ = regular(80.0)
    share = np.clip(at - 40.0, 0.0, 1.0)
    reported = follow(at, value + 10.0 * share**3 * (share * (6.0 * share - 15.0) + 10.0))
    assert "cough" not in {kind for kind, _ in onsets(reported, at)}


def test_events_of_a_volume_are_found_in_litres():
    choice = SignalChoice(signal="volume")
    at, value, episode = course("drift", 2, seed=52, drift_mm_s=0.4)
    found = first(follow(at, 0.1 * value, choice), at, "drift")
    assert episode.start_s < found < episode.start_s + 3.0 * find_build(2).period_s
    at, value, episode = course("sigh", 2, seed=52)
    assert first(follow(at, 0.1 * value, choice), at, "sigh") is not None


@pytest.mark.parametrize("offset", [-3.0, 2.0])
def test_one_exhale_that_ends_elsewhere_is_no_drift(offset):
    at, value, _ = regular(80.0)
    around = np.exp(-(((at - 42.4) / 1.0) ** 2))  # at 60 %, the end of exhale
    reported = follow(at, value + offset * around)
    assert "drift" not in {kind for kind, _ in onsets(reported, at)}


def test_an_event_that_was_under_way_is_not_reported_behind_a_gap_but_a_drift_is():
    at, value, _ = regular(80.0)
    value = value + np.where(at > 30.0, 4.0, 0.0) + spikes(at, 60.0, 3, 10.0)
    kept = (at < 61.3) | (at > 62.3)
    reported = follow(at[kept], value[kept])
    before, behind = reported[np.searchsorted(at[kept], 61.2)], reported[np.searchsorted(at[kept], 62.31)]
    assert kinds(before) == {"cough", "drift"}
    assert kinds(behind) == {"drift"}


def test_a_cough_makes_no_breath():
    at, value, _ = regular(48.0)
    state = start_breathing(SignalChoice())
    for seconds, one in zip(at.tolist(), (value + spikes(at, 42.4, 4, 15.0)).tolist(), strict=True):
        state = follow_breathing(state, seconds, one)
    assert not [cycle for cycle in state.history.cycles if 42.2 < cycle.end_s < 44.0]
    assert not [at_s for at_s, _ in state.history.lows if 42.2 < at_s < 44.0]
