import numpy as np
import pytest
from scipy.signal import find_peaks

from lab.phantom.breathing import IRREGULAR, REGULAR, Breathing, breathe, time_grid
from lab.phantom.builds import BUILDS, find_build


def breaths(build, habit, seconds=120.0, seed=0):
    signals = breathe(build, habit, time_grid(seconds), np.random.default_rng(seed))
    peaks, _ = find_peaks(signals.abdomen_mm, prominence=0.25 * build.amplitude_mm, distance=60)
    return signals, peaks


@pytest.mark.parametrize("build", BUILDS, ids=lambda build: f"bmi{build.bmi}")
def test_regular_breaths_are_eight_to_twelve_mm_every_three_to_five_seconds(build):
    signals, peaks = breaths(build, REGULAR)
    heights, lengths = signals.abdomen_mm[peaks], np.diff(signals.time_s[peaks])
    assert 7.7 < heights.mean() < 12.3
    assert 2.9 < lengths.mean() < 5.1
    assert heights.std() / heights.mean() < 0.08
    assert lengths.std() / lengths.mean() < 0.08
    assert -0.3 < signals.abdomen_mm.min() < 0.3


def test_irregular_breaths_differ_several_times_more():
    build = find_build(1)
    for measure in (lambda s, p: s.abdomen_mm[p], lambda s, p: np.diff(s.time_s[p])):
        regular, irregular = (measure(*breaths(build, habit, 300.0)) for habit in (REGULAR, IRREGULAR))
        assert irregular.std() / irregular.mean() > 3.0 * regular.std() / regular.mean()


def test_breathing_in_is_faster_than_breathing_out():
    signals, _ = breaths(find_build(1), REGULAR)
    speed = np.gradient(signals.abdomen_mm, signals.time_s)
    assert speed.max() > -1.1 * speed.min()


def test_parts_of_the_skin_follow_one_signal_with_their_own_delays():
    build = find_build(1)
    signals, _ = breaths(build, REGULAR)
    breathing = Breathing(signals, build)
    times = np.arange(5.0, 60.0, 0.01)
    weights = breathing.weights(times)
    lags = []
    for k in range(6):
        shifts = np.arange(-20, 90)
        errors = [
            np.abs(np.roll(weights[:, 0 if k < 3 else 3], shift) - weights[:, k])[200:-200].mean() for shift in shifts
        ]
        lags.append(shifts[int(np.argmin(errors))] * 0.01)
    late = 1.3 * build.spread_lag_s
    assert lags == pytest.approx([0.0, late / 2, late, 0.0, late / 2, late], abs=0.02)


def test_a_delay_never_asks_for_time_before_the_signal():
    build = find_build(9)
    signals, _ = breaths(build, REGULAR, 5.0)
    weights = Breathing(signals, build).weights(np.array([-10.0, 0.0, 5.0, 100.0]))
    assert np.all(np.isfinite(weights))
    assert np.abs(weights).max() < 15.0
