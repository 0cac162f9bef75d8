"""Cycles are counted breath by breath, whatever the breath beside it is like, and noise is never counted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.motion.breathing import count_cycles
from engine.qa.recorded_traces import read_trace
from lab.phantom.breathing import IRREGULAR, REGULAR, breathe, time_grid
from lab.phantom.builds import find_build
from lab.phantom.episodes import LOST, lay_out_course

DATA = Path(__file__).parents[3] / "data"
SECONDS = 44.0
TIME_S = np.arange(0.0, SECONDS, 1 / 30)
WHOLE = 0.6  # of the abdomen's motion


def noisy(signal_mm, *, seed=0, noise_mm=0.1):
    return signal_mm + np.random.default_rng(seed).normal(0.0, noise_mm, len(signal_mm))


def volunteer(number, habit):
    """Signal of a volunteer [mm]."""
    grid = time_grid(SECONDS)
    abdomen_mm = breathe(find_build(number), habit, grid, np.random.default_rng(number)).abdomen_mm
    return WHOLE * np.interp(TIME_S, grid, abdomen_mm)


def inhales_of(number, habit):
    """Number of times the volunteer leaves the rest between two breaths, which is 0 without wander."""
    rests = volunteer(number, replace(habit, wander_mm=0.0)) < 1e-3 * find_build(number).amplitude_mm
    return int((~rests[1:] & rests[:-1]).sum())


@pytest.mark.parametrize("habit", [REGULAR, IRREGULAR, LOST], ids=["regular", "irregular", "lost"])
@pytest.mark.parametrize("noise_mm", [0.02, 0.3])
def test_every_breath_of_an_irregular_patient_counts(habit, noise_mm):
    """One threshold for all breaths counted 3 of 13: the deepest breath hid the others."""
    for number in range(1, 11):
        inhales, signal_mm = inhales_of(number, habit), volunteer(number, habit)
        for drift_mm_s in (0.0, 0.05, -0.05):
            counted = count_cycles(noisy(signal_mm + drift_mm_s * TIME_S, noise_mm=noise_mm), TIME_S)
            assert inhales - 2 <= counted <= inhales, (number, counted, inhales)


@pytest.mark.parametrize(
    ("file", "until_s", "cycles"),  # counted by eye on a plot of the file
    [
        ("markers/201205101522-LAC-1-N-138-6.csv", 138.0, 20),
        ("markers/201205101522-UCC-1-N-138-6.csv", 138.0, 21),
        ("markers/201205101541-LAC-1-N-130-6.csv", 131.0, 20),
        ("rpm/PT01_PT09-2_13112021.vxp", 44.0, 7),
        ("qa/LiverTraj_LargeSIandAP70s_robot.txt", 44.0, 11),
        ("qa/LiverTraj_BreathHold1_robot.txt", 200.0, 0),
    ],
)
@pytest.mark.parametrize("noise_mm", [0.0, 0.1])
def test_recorded_breaths_are_counted(file, until_s, cycles, noise_mm):
    trace = read_trace(DATA / file)
    seconds = np.arange(0.0, min(until_s, trace.seconds), 1 / 30)
    assert count_cycles(noisy(trace.at(seconds), noise_mm=noise_mm), seconds) == cycles
    own = trace.time_s <= until_s  # at the rate of the file, 5 to 25 Hz
    assert abs(count_cycles(trace.motion_mm[own], trace.time_s[own]) - cycles) <= 1


@pytest.mark.parametrize("kind", ["sigh", "talking", "drift", "cough"])
def test_an_episode_neither_hides_breaths_nor_adds_any(kind):
    grid, seconds = time_grid(60.0), np.arange(0.0, 60.0, 1 / 30)
    for number in range(1, 11):
        course = lay_out_course(
            find_build(number), grid, 60.0, np.random.default_rng(number), kinds=(kind,), quiet_s=8.0
        )
        inhales = int(((course.peaks_s > 0.0) & (course.peaks_s < 60.0)).sum())
        counted = count_cycles(noisy(WHOLE * np.interp(seconds, grid, course.signals.abdomen_mm)), seconds)
        assert inhales - 2 <= counted <= inhales, (number, counted, inhales)


def test_a_held_breath_is_no_cycle():
    grid, seconds = time_grid(60.0), np.arange(0.0, 60.0, 1 / 30)
    course = lay_out_course(find_build(1), grid, 60.0, np.random.default_rng(3), kinds=("apnoea",), quiet_s=8.0)
    inhales = int(((course.peaks_s > 0.0) & (course.peaks_s < 60.0)).sum())
    signal_mm = noisy(WHOLE * np.interp(seconds, grid, course.signals.abdomen_mm))
    assert inhales - 3 <= count_cycles(signal_mm, seconds) <= inhales
    (episode,) = course.episodes
    held = (seconds > episode.start_s) & (seconds < episode.end_s)
    assert count_cycles(signal_mm[held], seconds[held]) == 0


@pytest.mark.parametrize("noise_mm", [0.05, 0.3, 1.0, 3.0, 10.0])
def test_noise_drift_and_a_heartbeat_are_no_breaths(noise_mm):
    heart_mm = 0.2 * np.sin(2.0 * np.pi * 1.2 * TIME_S)
    for seed in range(5):
        noise = noisy(np.zeros(len(TIME_S)), seed=seed, noise_mm=noise_mm)
        correlated = np.convolve(noise, [0.5, 0.3, 0.2], mode="same")
        for still_mm in (0.0, heart_mm, 0.1 * TIME_S, np.where(TIME_S > 20.0, 6.0, 0.0)):
            assert count_cycles(still_mm + noise, TIME_S) == 0
            assert count_cycles(still_mm + correlated, TIME_S) == 0


def test_coughs_of_a_patient_who_holds_the_breath_are_no_breaths():
    spikes_mm = sum(
        12.0 * np.sin(np.clip((TIME_S - at_s) / 0.3, 0.0, 1.0) * np.pi) ** 2 for at_s in (8.0, 8.5, 9.0, 9.5, 10.1)
    )
    assert count_cycles(noisy(spikes_mm), TIME_S) == 0


@pytest.mark.parametrize("level", [0.0, -3.0, 1e4])
def test_a_static_plate_has_no_cycles(level):
    assert count_cycles(np.full(len(TIME_S), level), TIME_S) == 0
    assert count_cycles(np.full(2, level), np.zeros(2)) == 0


def test_a_wander_slower_than_any_breath_has_no_cycles():
    seconds = np.arange(0.0, 200.0, 1 / 30)
    assert count_cycles(noisy(2.0 * np.sin(2.0 * np.pi * seconds / 40.0)), seconds) == 0


def test_single_damaged_frames_hide_no_breath_and_are_none():
    seconds = np.arange(0.0, 20.0, 1.0 / 30.0)
    rng = np.random.default_rng(4)
    breathing = 4.0 - 4.0 * np.cos(2.0 * np.pi * seconds / 4.0)
    damage = np.where(rng.random(len(seconds)) < 0.05, rng.normal(0.0, 2000.0, len(seconds)), 0.0)
    assert count_cycles(breathing + damage, seconds) == count_cycles(breathing, seconds) == 4
    assert count_cycles(damage, seconds) == 0
