"""A series read at other times than its own."""

import numpy as np
import pytest

from lab.evaluation.instruments.agreement import fit_at

PERIOD_US = 33_367
TIMES_US = 1_000 + PERIOD_US * np.arange(90)


def series(time_us):
    """Two series of two channels, parabolas over the whole time."""
    t = np.asarray(time_us) * 1e-6
    return np.stack([np.stack([t**2, 3.0 - t], axis=-1), np.stack([5.0 * t, 1.0 + 0.0 * t], axis=-1)], axis=1)


def test_a_parabola_is_read_exactly_between_samples():
    wanted = TIMES_US[:-1] + np.linspace(0, PERIOD_US, 89).astype(np.int64)
    assert fit_at(TIMES_US, series(TIMES_US), wanted) == pytest.approx(series(wanted), abs=1e-9)


def test_noise_of_single_samples_is_more_than_halved_in_the_middle():
    noise = np.random.default_rng(3).normal(0.0, 1.0, (90, 200, 1))
    read = fit_at(TIMES_US, noise, TIMES_US[20:70])
    assert read.std() < 0.65
    assert read.std() > 0.4


def test_a_breath_is_not_flattened():
    def breath(time_us):
        return 6.0 * np.sin(2.0 * np.pi * np.asarray(time_us) * 1e-6 / 3.0)[:, None, None]

    wanted = TIMES_US[5:-5] + 11_000
    assert np.abs(fit_at(TIMES_US, breath(TIMES_US), wanted) - breath(wanted)).max() < 0.01


def test_slow_cameras_have_three_samples_too():
    slow = np.arange(20) * 150_000
    wanted = slow[2:-2] + 40_000
    assert fit_at(slow, series(slow), wanted) == pytest.approx(series(wanted), abs=1e-9)


def test_nothing_is_read_before_the_first_sample_after_the_last_or_inside_a_gap():
    values = series(TIMES_US)
    values[30:40] = np.nan
    wanted = np.concatenate([[TIMES_US[0] - 5_000, TIMES_US[-1] + 5_000], TIMES_US[29:41], TIMES_US[29:30] + 9_000])
    is_read = np.isfinite(fit_at(TIMES_US, values, wanted)).all(axis=(1, 2))
    # The samples at the rims of the gap are at the wanted time itself.
    assert is_read.tolist() == [False, False, True, *[False] * 10, True, False]


def test_one_series_gone_leaves_the_other():
    values = series(TIMES_US)
    values[:, 0] = np.nan
    read = fit_at(TIMES_US, values, TIMES_US[5:10])
    assert np.isnan(read[:, 0]).all()
    assert read[:, 1] == pytest.approx(series(TIMES_US[5:10])[:, 1])


def test_at_the_ends_each_sample_counts_once():
    noise = np.random.default_rng(4).normal(0.0, 1.0, (90, 1, 1))
    near = np.abs(TIMES_US - TIMES_US[0]) <= 120_000
    line = np.polyfit((TIMES_US[near] - TIMES_US[0]) * 1e-6, noise[near, 0, 0], 2)
    assert fit_at(TIMES_US, noise, TIMES_US[:1])[0, 0, 0] == pytest.approx(line[-1])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_samples_give_nothing(count):
    assert np.isnan(fit_at(TIMES_US[:count], series(TIMES_US[:count]), TIMES_US[:5])).all()
    assert fit_at(TIMES_US, series(TIMES_US), TIMES_US[:0]).shape == (0, 2, 2)
