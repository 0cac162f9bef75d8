"""Components are smoothed as far as noise and pixel locking require, and no further."""

import cv2
import numpy as np
import pytest

from engine.motion.learning.shape_smoothing import Bands, estimate_errors, gaussian, smooth_shapes, weighted_sums

ROWS, COLUMNS = np.mgrid[0:350:2, 0:200:2].astype(np.float32)
KNOWN = np.ones(ROWS.shape, dtype=bool)
FRAMES = 150
SIGNAL = np.sin(2.0 * np.pi * np.arange(FRAMES) / 30.0) + 0.2 * np.sin(2.0 * np.pi * np.arange(FRAMES) / 71.0)
# A breath with a fold of 30 px in it [mm per unit of the signal].
BREATH_MM = -4.0 - 1.5 * np.sin(ROWS / 90.0) - 0.4 * np.exp(-(((ROWS - 200.0) / 15.0) ** 2))
DEPTH_MM = 850.0
PERIOD_MM = DEPTH_MM**2 / 43_000.0


def field(rng, window):
    noise = rng.standard_normal(ROWS.shape).astype(np.float32)
    blurred = cv2.blur(noise, (window, window))
    return blurred / blurred.std()


def readings(locking_mm, noise_mm=0.5, seed=4):
    """Frames without their mean, shape (n, m), and orthonormal scores, shape (n, 1)."""
    rng = np.random.default_rng(seed)
    motion = SIGNAL[:, None, None] * BREATH_MM
    phase = 2.0 * np.pi * motion / PERIOD_MM
    error = field(rng, 6) * np.cos(phase) + field(rng, 6) * np.sin(phase)
    frames = motion + locking_mm / np.sqrt(2.0) * error
    frames += noise_mm * np.stack([field(rng, 3) for _ in range(FRAMES)])
    centred = (frames - frames.mean(axis=0)).reshape(FRAMES, -1).astype(np.float32)
    score = SIGNAL - SIGNAL.mean()
    return centred, (score / np.linalg.norm(score)).astype(np.float32)[:, None]


def errors_mm(centred, scores):
    """True and stated error of the smoothed component [mm per unit of the signal], the true one off the edges."""
    ((shape, stated_mm),) = smooth_shapes(centred, scores, KNOWN, 2, np.full(KNOWN.shape, DEPTH_MM))
    unit = float(np.linalg.norm(SIGNAL - SIGNAL.mean()))
    return float(np.sqrt(np.square(shape / unit - BREATH_MM)[8:-8, 8:-8].mean())), stated_mm / unit


def shape_error_mm(centred, scores):
    return errors_mm(centred, scores)[0]


def ratio_of(centred, scores):
    bands = Bands(KNOWN, 2)
    wide = [bands.split(shape)[1][KNOWN] for shape in scores.T @ centred]
    return estimate_errors(weighted_sums(centred, scores, KNOWN), scores, wide, bands, DEPTH_MM).locking_ratio


@pytest.fixture(scope="module")
def clean():
    return readings(0.0)


@pytest.fixture(scope="module")
def locked():
    return readings(0.35)


def test_locking_is_reported_from_noise_by_its_curvature(clean, locked):
    assert ratio_of(*clean) == pytest.approx(1.0, abs=0.25)
    assert ratio_of(*locked) > 1.6


def test_without_locking_a_fold_of_the_body_is_kept(clean):
    assert shape_error_mm(*clean) < 0.03


def test_locking_is_smoothed_away_although_it_repeats_in_every_breath(locked, monkeypatch):
    smoothed = shape_error_mm(*locked)
    monkeypatch.setattr("engine.motion.learning.shape_smoothing.CAUTION", 0.0)
    assert smoothed < 0.65 * shape_error_mm(*locked)


@pytest.mark.parametrize("kind", ["clean", "locked"])
def test_the_error_that_is_left_is_stated(kind, request):
    true_mm, stated_mm = errors_mm(*request.getfixturevalue(kind))
    assert true_mm / 2.0 < stated_mm < 2.0 * true_mm


def test_the_bands_add_up_to_the_finest_smoothing():
    surface = field(np.random.default_rng(9), 5)
    fine, wide = Bands(KNOWN, 2).split(surface.ravel())
    assert np.abs(sum(fine) + wide - gaussian(surface, 2.0)).max() < 1e-5


def test_a_slope_stays_a_slope_up_to_the_edge():
    slope = (0.02 * ROWS - 0.01 * COLUMNS).astype(np.float32)
    assert np.abs(gaussian(slope, 6.0) - slope).max() < 1e-3
    fine, wide = Bands(KNOWN, 2).split(slope.ravel())
    assert np.abs(wide - slope).max() < 1e-3
    assert max(np.abs(band).max() for band in fine) < 1e-3


def test_the_widest_kernel_leaves_more_of_a_fold_than_a_gaussian_of_its_width():
    fold = np.exp(-(((ROWS - 170.0) / 40.0) ** 2)).astype(np.float32)
    _, wide = Bands(KNOWN, 2).split(fold.ravel())
    assert 1.0 - wide.max() < 0.7 * (1.0 - gaussian(fold, 16.0).max())
