"""Places in the breath, bins and the phase list, against breaths whose places are known."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from engine.core.errors import InvalidValueError
from service.exchange.four_d_ct import (
    Sorting,
    at_times,
    bins_of,
    bins_table,
    breaths_of,
    phase_list,
    places_in_breath,
)
from tests.support.exchange.breaths import PERIOD_S, RATE, breath


def apart(one, two):
    return np.abs((one - two + 0.5) % 1.0 - 0.5)


@given(period_s=st.floats(2.0, 8.0), depth_mm=st.floats(3.0, 30.0), noise_mm=st.floats(0.0, 0.1))
def test_the_place_is_the_time_since_the_end_of_inhale(period_s, depth_mm, noise_mm):
    at, motion = breath(60.0, period_s, depth_mm, noise_mm)
    place = places_in_breath(at, motion)
    known = np.isfinite(place)
    assert known.mean() > 0.6
    assert ((place[known] >= 0.0) & (place[known] < 1.0)).all()
    assert apart(place[known], (at[known] / period_s) % 1.0).max() < 0.08


def test_before_the_first_and_after_the_last_end_of_inhale_it_is_not_known():
    at, motion = breath()
    breaths = breaths_of(at, motion)
    place = places_in_breath(at, motion)
    assert np.isnan(place[: breaths.inhale[0]]).all()
    assert np.isnan(place[breaths.inhale[-1] :]).all()
    assert np.isfinite(place[breaths.inhale[0] : breaths.inhale[-1]]).all()


def test_a_pause_longer_than_a_breath_may_last_has_no_place():
    at, motion = breath(60.0)
    motion[(at > 12.0) & (at < 32.0)] = 0.0
    place = places_in_breath(at, motion)
    assert np.isnan(place[(at > 13.0) & (at < 31.0)]).all()
    assert np.isfinite(place[(at > 5.0) & (at < 7.0)]).all()


def test_by_amplitude_the_way_down_and_the_way_up_are_apart():
    at, motion = breath()
    for sorting in (Sorting.EQUAL_AMPLITUDE, Sorting.LOCAL_AMPLITUDE):
        place = places_in_breath(at, motion, sorting)
        phase = (at / PERIOD_S) % 1.0
        known = np.isfinite(place) & (np.abs(phase - 0.5) > 0.1) & (phase > 0.1) & (phase < 0.9)
        np.testing.assert_array_equal(place[known] < 0.5, phase[known] < 0.5)


def test_local_amplitudes_follow_a_drift_that_equal_amplitudes_take_for_motion():
    at, motion = breath(80.0, drift_mm_s=0.2)
    spread = {
        sorting: np.nanstd(places_in_breath(at, motion, sorting)[np.abs((at / PERIOD_S) % 1.0 - 0.5) < 0.02])
        for sorting in (Sorting.EQUAL_AMPLITUDE, Sorting.LOCAL_AMPLITUDE)
    }
    assert spread[Sorting.LOCAL_AMPLITUDE] < 0.5 * spread[Sorting.EQUAL_AMPLITUDE]


def test_bins_hold_all_of_the_time_and_their_residual_is_what_moves_within_them():
    at, motion = breath(depth_mm=10.0)
    found = bins_of(motion, places_in_breath(at, motion), 10)
    assert sum(one.share for one in found) == pytest.approx(1.0)
    assert found[0].mean_mm == pytest.approx(10.0, abs=0.2)
    assert found[5].mean_mm == pytest.approx(0.0, abs=0.2)
    assert found[2].residual_mm > 3.0 * found[5].residual_mm, "the flank moves, the pause does not"
    table = bins_table(found).splitlines()
    assert (table[0], len(table)) == ("bin,middle,share,mean_mm,residual_mm,range_90_mm", 11)


@pytest.mark.parametrize("count", [1, 21])
def test_a_number_of_bins_out_of_its_bounds_is_refused(count):
    at, motion = breath()
    with pytest.raises(InvalidValueError, match=f"bins.*{count}.*2"):
        bins_of(motion, places_in_breath(at, motion), count)


def test_an_empty_bin_has_no_motion():
    at, motion = breath()
    place = np.where(apart(places_in_breath(at, motion), 0.5) < 0.05, np.nan, places_in_breath(at, motion))
    assert bins_of(motion, place, 10)[5].mean_mm is None


def test_images_between_two_values_lie_between_their_places_also_round_the_end_of_inhale():
    at, motion = breath()
    place = places_in_breath(at, motion)
    images = np.arange(5.0, 35.0, 0.0471)
    assert apart(at_times(at, place, images), (images / PERIOD_S) % 1.0).max() < 0.03
    assert np.isnan(at_times(at, place, np.array([-1.0, 41.0]))).all()


def test_the_phase_list_is_what_rtk_reads():
    """RTK's PhaseReader: one number a line, each from 0 to below 1, as many as there are projections."""
    at, motion = breath()
    place = places_in_breath(at, motion)
    known = place[np.isfinite(place)]
    lines = phase_list(known).splitlines()
    assert len(lines) == len(known)
    values = np.array([float(line) for line in lines])
    assert ((values >= 0.0) & (values < 1.0)).all()
    assert apart(values, known).max() < 1e-5
    assert float(phase_list(np.array([0.9999999]))) < 1.0


def test_a_projection_without_a_place_is_refused_by_its_number():
    with pytest.raises(InvalidValueError, match="image 2 and 1 more"):
        phase_list(np.array([0.1, np.nan, np.nan]))


@pytest.mark.parametrize("motion", [np.full(300, np.nan), np.zeros(300), 0.2 * np.sin(np.arange(300) / 10.0)])
def test_what_does_not_breathe_is_refused(motion):
    with pytest.raises(InvalidValueError, match="at least two breaths"):
        places_in_breath(np.arange(300) / RATE, motion)
