"""The maps of a model's quality: the deepest breath without holes, and a difference that is the noise."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.frames import Projection, RoiDepth
from engine.core.motion_model import MotionModel
from engine.motion.learning.training_quality import with_quality_maps
from engine.motion.stages.projection import prepare_basis, project

NOISE_MM = 0.8
FRAMES = 24
HOLE = (slice(180, 200), slice(60, 80))
BETA_MM = 1500.0
"""First coefficient of the deepest breath [mm]: 20 mm in the middle."""


@pytest.fixture(scope="module")
def model():
    rows, columns = np.mgrid[0:350, 0:200]
    component = -np.exp(-(((rows - 200.0) / 50.0) ** 2) - ((columns - 100.0) / 35.0) ** 2)[None]
    component = (component / np.linalg.norm(component)).astype(np.float32)
    known = np.ones((350, 200), dtype=np.bool_)
    known[HOLE] = False
    return MotionModel(
        mean_mm=np.full((350, 200), 850.0, dtype=np.float32),
        components=component,
        eigenvalues_mm2=np.array([BETA_MM**2]),
        known=known,
        training_frames=FRAMES,
        cycles=3,
        seconds=12.0,
        calibration_sha256="ab" * 32,
        noise_mm=NOISE_MM,
    )


@pytest.fixture(scope="module")
def explained(model) -> list[tuple[RoiDepth, Projection]]:
    """Frames of a breath with noise and a hole, as the pipeline explains them; the deepest is the seventh."""
    random = np.random.default_rng(3)
    basis = prepare_basis(model)
    found = []
    for i in range(FRAMES):
        beta = np.array([BETA_MM * np.cos((i - 6) * 2.0 * np.pi / FRAMES)], dtype=np.float32)
        depth = model.reconstruct(beta) + random.normal(0.0, NOISE_MM, (350, 200)).astype(np.float32)
        roi = RoiDepth(depth_mm=depth.astype(np.float32), valid=model.known.copy())
        outcome = project(basis, roi, None)
        assert outcome is not None
        found.append((roi, outcome))
    return found


@pytest.fixture(scope="module")
def shown(model, explained):
    return with_quality_maps(model, prepare_basis(model), explained)


def test_the_deepest_inhale_is_shown_as_measured_with_its_hole(shown, explained):
    thinned = explained[6][0].thinned(4)
    assert np.array_equal(np.isnan(shown.sample_raw_mm), ~thinned.valid)
    assert np.array_equal(shown.sample_raw_mm[thinned.valid], thinned.depth_mm[thinned.valid])


def test_its_reconstruction_has_neither_noise_nor_hole(shown, model):
    truth_mm = model.reconstruct(np.array([BETA_MM]))[::4, ::4]
    hole = ~model.known[::4, ::4]
    assert np.abs(truth_mm - 850.0)[hole].min() > 5.0, "the breath moves what the training did not see"
    assert np.abs(shown.sample_reconstructed_mm - truth_mm).max() <= 0.4 * NOISE_MM


def test_the_difference_is_the_noise_and_nothing_is_stated_of_the_hole(shown, model):
    thinned = model.known[::4, ::4]
    assert np.array_equal(np.isnan(shown.residual_map_mm), ~thinned)
    # of n values, an RMS scatters by 1/sqrt(2 n) of itself
    assert np.abs(shown.residual_map_mm[thinned].mean() - NOISE_MM) <= 0.05 * NOISE_MM
    assert shown.residual_map_mm[thinned].max() <= 2.0 * NOISE_MM


def test_a_part_that_the_model_does_not_explain_stands_out(model, explained):
    changed = []
    for i, (roi, outcome) in enumerate(explained):
        depth = roi.depth_mm.copy()
        depth[300:340, 20:60] += 6.0 * (-1.0) ** i
        changed.append((replace(roi, depth_mm=depth), outcome))
    found = with_quality_maps(model, prepare_basis(model), changed).residual_map_mm
    assert found is not None
    assert found[75:85, 5:15].min() > 4.0 > 2.0 * NOISE_MM > np.nanmax(found[:70])
