"""What a patient does beside quiet breathing: labelled to the moment, and as deep, fast and long as said."""

import itertools

import numpy as np
import pytest

from lab.phantom.breathing import time_grid
from lab.phantom.builds import find_build
from lab.phantom.episodes import KINDS, lay_out_course

SECONDS = 260.0
GRID = time_grid(SECONDS)


def course_of(seed, kinds=KINDS, **wanted):
    return lay_out_course(find_build(2), GRID, SECONDS, np.random.default_rng(seed), kinds=kinds, **wanted)


def during(episode):
    return (episode.start_s <= GRID) & (episode.end_s > GRID)


@pytest.mark.parametrize("seed", range(4))
def test_every_kind_comes_once_with_quiet_breathing_before_and_between(seed):
    episodes = course_of(seed).episodes
    assert tuple(episode.kind for episode in episodes) == KINDS
    assert episodes[0].start_s >= 16.0
    gaps = [after.start_s - before.end_s for before, after in itertools.pairwise(episodes)]
    assert min(gaps) >= 15.9
    assert episodes[-1].end_s < SECONDS


@pytest.mark.parametrize("seed", range(6))
def test_a_cough_is_two_to_four_fast_spikes_of_5_to_20_mm(seed):
    course = course_of(seed, ("cough",))
    (cough,) = course.episodes
    spikes = course.signals.abdomen_mm - course_of(seed, ()).signals.abdomen_mm
    inside = spikes[during(cough)]
    tops = (inside[1:-1] > inside[:-2]) & (inside[1:-1] >= inside[2:]) & (inside[1:-1] > 3.0)
    assert 2 <= tops.sum() == cough.detail["coughs"] <= 4
    assert 0.5 < cough.end_s - cough.start_s < 2.8
    assert 4.5 < inside.max() < 21.0


@pytest.mark.parametrize("seed", range(4))
def test_an_apnoea_rests_at_the_end_of_exhale_for_ten_to_twenty_seconds(seed):
    course = course_of(seed, ("apnoea",))
    (apnoea,) = course.episodes
    assert 10.0 <= apnoea.end_s - apnoea.start_s <= 20.0
    assert np.ptp(course.signals.abdomen_mm[during(apnoea)]) < 0.2
    assert abs(course.signals.abdomen_mm[during(apnoea)]).max() < 0.2


@pytest.mark.parametrize("seed", range(4))
def test_a_sigh_is_twice_as_deep_as_the_breaths_before(seed):
    course = course_of(seed, ("sigh",))
    (sigh,) = course.episodes
    quiet = np.percentile(course.signals.abdomen_mm[(GRID > 0.0) & (GRID < 16.0)], 98)
    assert 1.7 < course.signals.abdomen_mm[during(sigh)].max() / quiet < 2.6


@pytest.mark.parametrize("rate", [0.1, -0.4, 0.74])
def test_a_drift_goes_at_its_rate_and_stays_where_it_came_to(rate):
    course = course_of(1, ("drift",), drift_mm_s=rate)
    (drift,) = course.episodes
    signal = course.signals.abdomen_mm
    rest_before, rest_after = signal[(GRID > 0.0) & (GRID < 16.0)].min(), signal[drift.end_s < GRID].min()
    assert rest_after - rest_before == pytest.approx(rate * (drift.end_s - drift.start_s), abs=0.3)
    assert abs(rest_after - rest_before) <= 8.3
    assert drift.detail == {"mm_s": rate}


def test_speech_is_quick_in_and_long_out():
    course = course_of(3, ("talking",))
    (talking,) = course.episodes
    peaks = course.peaks_s[(course.peaks_s > talking.start_s) & (course.peaks_s < talking.end_s)]
    assert 4 <= len(peaks) <= 8
    assert 18.0 <= talking.end_s - talking.start_s < 30.0
    rises = np.diff(course.signals.abdomen_mm[during(talking)]) / 0.02
    quiet = np.diff(course.signals.abdomen_mm[(GRID > 0.0) & (GRID < 16.0)]) / 0.02
    assert rises.max() > 1.5 * quiet.max()
    assert (rises > 1.0).mean() < 0.3


def test_what_does_not_fit_into_the_recording_is_left_out():
    build = find_build(2)
    grid = time_grid(60.0)
    episodes = lay_out_course(build, grid, 60.0, np.random.default_rng(1)).episodes
    assert [episode.kind for episode in episodes] == ["sigh", "cough"]
    assert all(episode.end_s <= 60.0 for episode in episodes)
