"""Lag, correlation and scale of volumes that were made with known ones."""

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from lab.evaluation.instruments.flow_file import Spirometry
from lab.evaluation.instruments.spirometer import _at, compare_volumes, to_unit_range

FPS, RATE_HZ = 30.0, 100.0
SECONDS = 60.0
TIME_S = np.arange(0.0, SECONDS, 1.0 / FPS)


def lung_l(time_s):
    """Breaths of changing length and depth, so that no two stretches are alike; 0 at the end of exhale."""
    phase = 2.0 * np.pi * (time_s / 4.0 + 0.35 * np.sin(2.0 * np.pi * time_s / 23.0))
    return (0.5 + 0.12 * np.sin(2.0 * np.pi * time_s / 17.0 + 1.0)) * 0.5 * (1.0 - np.cos(phase))


def hold_l(time_s):
    """Breaths for half a minute, one deep breath held for 16 s, then breaths again; a straight line would tilt."""
    held = np.clip((time_s - 32.0) / 2.0, 0.0, 1.0) * np.clip((52.0 - time_s) / 2.0, 0.0, 1.0)
    return lung_l(time_s) * (1.0 - held) + 1.4 * held


def spirometer(lag_s, *, lung=lung_l, seconds=SECONDS, offset=0.0, noise=0.0, is_flow=True, sign=1.0):
    """What a spirometer makes of a lung; t seconds of the recording are t + lag_s on its clock."""
    time_s = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    if is_flow:
        step = 1e-3
        values = (lung(time_s - lag_s + step) - lung(time_s - lag_s - step)) / (2.0 * step) + offset
    else:
        values = lung(time_s - lag_s) + offset
    values = sign * values + np.random.default_rng(2).normal(0.0, noise, len(time_s))
    return Spirometry(time_s=time_s, values=values, is_flow=is_flow)


@pytest.mark.parametrize("lag_s", [-3.217, -0.4, 0.0, 0.018, 2.71])
@pytest.mark.parametrize("is_flow", [True, False])
def test_the_lag_is_found_to_milliseconds(lag_s, is_flow):
    found = compare_volumes(TIME_S, lung_l(TIME_S), spirometer(lag_s, is_flow=is_flow))
    assert found.lag_s == pytest.approx(lag_s, abs=0.005)
    assert found.correlation > 0.9999
    assert found.scale == pytest.approx(1.0, abs=0.01)
    assert found.error_percent < 0.5
    assert found.overlap_s == pytest.approx(SECONDS - abs(lag_s), abs=0.1)
    assert found.notices == []


def test_an_offset_of_the_flow_does_not_run_away():
    found = compare_volumes(TIME_S, lung_l(TIME_S), spirometer(1.1, offset=0.03, noise=0.02))
    assert found.lag_s == pytest.approx(1.1, abs=0.01)
    assert found.correlation > 0.998
    assert found.scale == pytest.approx(1.0, abs=0.03)
    assert np.nanmax(np.abs(found.spirometer_l - found.tidegate_l)) < 0.06


def test_a_breath_hold_is_no_drift():
    found = compare_volumes(TIME_S, hold_l(TIME_S), spirometer(0.7, lung=hold_l, offset=-0.02))
    assert found.correlation > 0.999
    is_held = (TIME_S > 35.0) & (TIME_S < 49.0)
    rests = [np.nanmin(found.spirometer_l[part]) for part in (TIME_S < 31.0, TIME_S > 53.0)]
    for rest in rests:
        assert found.spirometer_l[is_held] - rest == pytest.approx(np.full(is_held.sum(), 1.4), abs=0.1)


def test_scale_and_error_are_tidegate_s_against_the_spirometer_s():
    wrong = 0.8 * lung_l(TIME_S) + 0.02 * np.sign(np.sin(40.0 * TIME_S))
    found = compare_volumes(TIME_S, wrong, spirometer(0.5, is_flow=False))
    assert found.scale == pytest.approx(0.8, abs=0.01)
    span = np.ptp(np.percentile(wrong, [5.0, 95.0]))
    assert found.error_percent == pytest.approx(100.0 * 0.02 / span, rel=0.05)
    assert found.error_deviation_percent < 0.3 * found.error_percent


def test_frames_that_were_not_measured_stay_empty_and_cost_nothing_else():
    volume = lung_l(TIME_S)
    gone = (TIME_S < 12.0) | ((TIME_S > 30.0) & (TIME_S < 33.0))
    volume[gone] = np.nan
    found = compare_volumes(TIME_S, volume, spirometer(-1.3))
    assert found.lag_s == pytest.approx(-1.3, abs=0.005)
    assert np.isnan(found.tidegate_l[gone]).all()
    assert np.isnan(found.spirometer_l[gone]).all()
    assert np.isfinite(found.spirometer_l[~gone]).sum() == round(found.overlap_s * FPS)


def test_air_that_leaves_counted_positive_is_noticed_and_can_be_stated():
    exhaled = spirometer(0.9, sign=-1.0)
    assert "sign reversed" in compare_volumes(TIME_S, lung_l(TIME_S), exhaled).notices[0]
    found = compare_volumes(TIME_S, lung_l(TIME_S), exhaled, is_exhale_positive=True)
    assert found.lag_s == pytest.approx(0.9, abs=0.005)
    assert (found.correlation > 0.9999, found.notices) == (True, [])


def test_breathing_like_clockwork_fits_a_breath_later_too_and_states_it():
    def clockwork(time_s):
        return 0.25 * (1.0 - np.cos(2.0 * np.pi * time_s / 3.0))

    found = compare_volumes(TIME_S, clockwork(TIME_S), spirometer(1.0, lung=clockwork, noise=0.05))
    assert found.rival_lag_s is not None
    assert abs(found.rival_lag_s - found.lag_s) == pytest.approx(3.0, abs=0.2)
    assert "too regular" in found.notices[0]


def test_a_lag_beyond_the_window_is_refused_and_found_in_a_wider_one():
    late = spirometer(6.5)
    with pytest.raises(InvalidValueError, match=r"max-lag-s is 6\.3: must be larger"):
        compare_volumes(TIME_S, lung_l(TIME_S), late, max_lag_s=6.3)
    assert compare_volumes(TIME_S, lung_l(TIME_S), late, max_lag_s=8.0).lag_s == pytest.approx(6.5, abs=0.005)


def test_too_little_overlap_is_refused():
    with pytest.raises(InvalidValueError, match=r"overlap is '7\.\d s': must be 8 s or more"):
        compare_volumes(TIME_S, lung_l(TIME_S), spirometer(0.0, seconds=7.5))
    with pytest.raises(InvalidValueError, match="overlap is '0 measured frames'"):
        compare_volumes(TIME_S, np.full(len(TIME_S), np.nan), spirometer(0.0))


def test_a_volume_that_stands_still_is_refused():
    with pytest.raises(InvalidValueError):
        compare_volumes(TIME_S, np.ones(len(TIME_S)), spirometer(0.0))


@pytest.mark.parametrize("max_lag_s", [0.0, -1.0, 121.0, float("nan")])
def test_a_window_that_is_none_is_refused(max_lag_s):
    with pytest.raises(InvalidValueError, match="max-lag-s"):
        compare_volumes(TIME_S, lung_l(TIME_S), spirometer(0.0), max_lag_s=max_lag_s)


def test_a_slow_spirometer_is_splined_to_the_frames():
    """The article's spirometer had fewer samples than the camera has frames."""
    quick = spirometer(0.6, is_flow=False)
    slow = Spirometry(time_s=quick.time_s[::20].copy(), values=quick.values[::20].copy(), is_flow=False)
    found = compare_volumes(TIME_S, lung_l(TIME_S), slow)
    assert found.lag_s == pytest.approx(0.6, abs=0.005)
    assert np.nanmax(np.abs(found.spirometer_l - lung_l(TIME_S))) < 0.002


def test_a_change_across_a_gap_is_not_known():
    time_s = np.array([0.0, 0.1, 0.2, 5.0, 5.1])
    read = _at(time_s, 10.0 * time_s, np.array([-0.1, 0.05, 0.2, 2.0, 5.05, 5.2]))
    assert read == pytest.approx([np.nan, 0.5, 2.0, np.nan, 50.5, np.nan], nan_ok=True)


def test_the_unit_range_is_the_article_s():
    scaled = to_unit_range(np.array([2.0, np.nan, 3.0, 4.0]))
    assert scaled == pytest.approx([-1.0, np.nan, 0.0, 1.0], nan_ok=True)
