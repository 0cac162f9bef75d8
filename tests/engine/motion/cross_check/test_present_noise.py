"""The camera's noise now, by the cells' second differences; the smaller of the training's and today's counts."""

import math

import numpy as np
import pytest

from engine.motion.cross_check.present_noise import FILTERED_SHARE, LEAST_FRAMES, PresentNoise
from tests.support.gating.streams import PERIOD_US

SIDE_PX = 30.0
CELLS = 80


def shown(noise, sd_mm, frames=200, *, breath_mm=0.0, start=0, seed=3):
    """Show cells with noise."""
    random = np.random.default_rng(seed)
    for index in range(start, start + frames):
        breath = 0.5 * breath_mm * math.cos(2.0 * math.pi * index / 100.0)
        cells_mm = 850.0 + breath * np.linspace(0.2, 1.0, CELLS) + random.normal(0.0, sd_mm, CELLS)
        noise.add(cells_mm, (index + 1) * PERIOD_US)
    return noise


@pytest.mark.parametrize("breath_mm", [0.0, 20.0])
@pytest.mark.parametrize("sd_mm", [0.05, 0.17, 0.6])
def test_it_is_the_noise_of_a_cell_by_its_side_whatever_the_breath(sd_mm, breath_mm):
    assert shown(PresentNoise(SIDE_PX), sd_mm, breath_mm=breath_mm).noise_mm == pytest.approx(SIDE_PX * sd_mm, rel=0.15)


def test_it_is_not_known_in_the_first_second_and_a_half_and_after_gaps_goes_on():
    noise = shown(PresentNoise(SIDE_PX), 0.17, LEAST_FRAMES + 1)
    assert math.isnan(noise.noise_mm)
    assert noise.counting(5.0) == 5.0
    assert math.isnan(noise.share_of(5.0))
    shown(noise, 0.17, 2, start=500)
    assert math.isnan(noise.noise_mm), "two frames after a gap are no second difference"
    shown(noise, 0.17, 1, start=502)
    assert not math.isnan(noise.noise_mm)


@pytest.mark.parametrize(("trained_mm", "frames", "is_known"), [(5.0, 47, True), (5.0, 46, False), (0.0, 47, False)])
def test_a_share_is_known_where_both_noises_are(trained_mm, frames, is_known):
    noise = shown(PresentNoise(SIDE_PX), 0.17, frames)
    assert math.isfinite(noise.share_soon(trained_mm)) is math.isfinite(noise.share_of(trained_mm)) is is_known


def test_the_first_frames_count_alike():
    noise = shown(shown(PresentNoise(SIDE_PX), 0.1, 24), 0.3, LEAST_FRAMES - 22, start=24)
    assert noise.noise_mm == pytest.approx(SIDE_PX * math.sqrt(0.5 * (0.1**2 + 0.3**2)), rel=0.1)


def test_the_smaller_of_the_training_s_and_the_present_one_counts():
    noise = shown(PresentNoise(SIDE_PX), 0.17)
    assert noise.counting(22.5) == noise.noise_mm
    assert noise.counting(5.0) == 5.0
    assert noise.share_of(5.0) == pytest.approx(1.02, abs=0.15)


def test_cells_that_are_not_seen_and_a_hand_over_a_few_change_nothing():
    noise, random = PresentNoise(SIDE_PX), np.random.default_rng(5)
    for index in range(200):
        cells_mm = 850.0 + random.normal(0.0, 0.17, CELLS)
        cells_mm[:20] = np.nan
        cells_mm[20:30] += random.normal(0.0, 30.0)
        noise.add(cells_mm, (index + 1) * PERIOD_US)
    assert noise.noise_mm == pytest.approx(SIDE_PX * 0.17, rel=0.3)
    noise.add(np.full(CELLS, np.nan), 201 * PERIOD_US)
    assert math.isfinite(noise.noise_mm)


@pytest.mark.parametrize("weight", [0.1, 0.2, 0.3])
def test_a_filter_in_time_is_found_within_half_a_second_and_noise_alone_never_is(weight):
    noise = shown(PresentNoise(SIDE_PX), 0.17)
    trained_mm, shares = noise.noise_mm, []
    for index in range(200, 1_200):
        shown(noise, 0.17, 1, start=index, seed=index)
        shares.append(noise.share_soon(trained_mm))
    assert min(shares) > 1.5 * FILTERED_SHARE
    random, filtered, found = np.random.default_rng(8), None, None
    for index in range(1_200, 1_300):
        cells_mm = 850.0 + random.normal(0.0, 0.17, CELLS)
        filtered = cells_mm if filtered is None else filtered + weight * (cells_mm - filtered)
        noise.add(filtered, (index + 1) * PERIOD_US)
        if noise.share_soon(trained_mm) < FILTERED_SHARE:
            found = index - 1_200
            break
    assert found is not None
    assert found <= 15
