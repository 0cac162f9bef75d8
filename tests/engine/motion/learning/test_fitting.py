"""What is learned is the patient and not the noise: amplitude, edges, and how noisy the sensor is."""

import numpy as np
import pytest

from engine.core.errors import ModelError
from tests.support.motion.fitting_frames import BREATH, REST_MM, SIGNAL_MM, frames, learn

pytestmark = pytest.mark.slow


def share_of(model):
    """How much of the true breath's mean the first component carries."""
    first = model.components[0]
    return float((first * BREATH).sum() * first.mean() / BREATH.mean())


@pytest.mark.parametrize("noise_mm", [0.5, 2.0, 6.0])
def test_noise_does_not_make_motion_look_smaller(noise_mm):
    assert share_of(learn(*frames(noise_mm), components=1)) == pytest.approx(1.0, abs=0.004)


@pytest.mark.parametrize(("stride", "blur_px"), [(2, 0.0), (4, 0.0), (2, 1.2), (4, 0.6)])
def test_the_noise_is_measured_with_its_correlation(stride, blur_px):
    model = learn(*frames(1.0, stride=stride, blur_px=blur_px))
    # White noise of 1 mm on thinned points; a blur of b points makes its mean vary as if 4 pi b^2 of them were one.
    expected = stride * max(np.sqrt(4.0 * np.pi) * blur_px, 1.0)
    assert model.noise_mm == pytest.approx(expected, rel=0.17)


def test_breathing_itself_is_no_noise():
    assert learn(*frames(0.3)).noise_mm < 1.0


def test_thinned_frames_teach_what_full_ones_do():
    full, thin = (learn(*frames(0.8, stride=stride), components=1) for stride in (1, 2))
    assert full.components.shape == thin.components.shape
    assert np.abs(full.components[0] - thin.components[0]).max() < 0.04 * np.abs(full.components[0]).max()
    assert np.abs(full.mean_mm - thin.mean_mm).max() < 0.6
    assert thin.eigenvalues_mm2[0] == pytest.approx(full.eigenvalues_mm2[0], rel=0.02)


def test_a_third_of_the_readings_gone_changes_little():
    whole, holey = (learn(*frames(0.8, holes=share), components=1) for share in (0.0, 0.33))
    assert np.abs(holey.components[0] - whole.components[0]).max() < 0.05 * np.abs(whole.components[0]).max()
    assert holey.eigenvalues_mm2[0] == pytest.approx(whole.eigenvalues_mm2[0], rel=0.02)


def test_what_was_never_seen_is_unknown_and_finite():
    depth, valid = frames(0.8)
    valid[:, 40:60, 20:50] = False
    model = learn(depth, valid)
    assert not model.known[100, 60]
    assert model.known[200, 160]
    assert np.isfinite(model.components).all()


def test_points_that_were_seldom_seen_teach_nothing_whatever_they_read():
    depth, valid = frames(0.8)
    valid[:, 42:57, 23:48] = False
    never = learn(depth, valid)
    valid[::3, 42:57, 23:48] = True
    depth[:, 42:57, 23:48] += 30.0 * np.sin(np.arange(len(depth)))[:, None, None]
    seldom = learn(depth, valid)
    assert np.array_equal(seldom.known, never.known)
    assert seldom.components == pytest.approx(never.components, abs=1e-7)
    assert seldom.eigenvalues_mm2 == pytest.approx(never.eigenvalues_mm2, rel=1e-4, abs=1.0)
    assert seldom.noise_mm == pytest.approx(never.noise_mm, abs=1e-4)


def test_inhale_is_positive_whatever_the_first_frame_was():
    for signal in (SIGNAL_MM, SIGNAL_MM[::-1], 8.0 - SIGNAL_MM):
        model = learn(*frames(0.8, signal_mm=signal))
        assert model.components[0].mean() < 0.0


def test_nothing_that_moves_teaches_nothing():
    rest = np.repeat(REST_MM[None, ::2, ::2], 60, axis=0).astype(np.float32)
    with pytest.raises(ModelError, match="no motion"):
        learn(rest, np.ones_like(rest, dtype=bool))


def moving_in(ways, noise_mm=0.8):
    """Frames of a surface that moves in so many ways, each a wave of its own along the body and in time."""
    depth, valid = frames(noise_mm, signal_mm=np.zeros(160))
    rows = np.linspace(0.0, np.pi, depth.shape[1], dtype=np.float32)[:, None]
    times = np.linspace(0.0, 2.0 * np.pi, len(depth), dtype=np.float32)
    for way in range(1, ways + 1):
        depth -= (4.0 / way) * np.sin((way + 3.0) * times)[:, None, None] * np.cos((way - 1.0) * rows)
    return depth, valid


@pytest.mark.parametrize(("ways", "noise_mm"), [(1, 0.8), (2, 0.8), (4, 0.8), (6, 0.8), (4, 6.0)])
def test_one_component_is_kept_for_each_way_the_body_moves(ways, noise_mm):
    assert len(learn(*moving_in(ways, noise_mm), components=6).components) == ways


def test_no_more_components_are_kept_than_the_setting_allows():
    assert len(learn(*moving_in(4), components=3).components) == 3
    assert len(learn(*moving_in(4), components=1).components) == 1
