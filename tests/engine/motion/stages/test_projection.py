"""A frame decides how far the learned components are to be trusted, and who in the picture is to be believed."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.frames import RoiDepth
from engine.motion.stages import projection
from engine.motion.stages.projection import CHECK_CLIP_MM, PRIOR_SPREADS_MM, STRIDE_PX, modes_of, prepare_basis, project
from tests.support.motion.fitting_frames import BREATH, COLUMNS, REST_MM, ROWS, frames, learn

THIN = (slice(None, None, STRIDE_PX),) * 2
HOLD = np.exp(-(((ROWS - 70.0) / 80.0) ** 2) - ((COLUMNS - 100.0) / 90.0) ** 2)


@pytest.fixture(scope="module")
def model():
    return learn(*frames(1.0), components=1)


@pytest.fixture(scope="module")
def basis(model):
    return prepare_basis(model)


def roi(amplitude_mm=4.0, seed=0, noise_mm=1.0, extra=None, hole=None):
    surface = REST_MM - amplitude_mm * BREATH
    if extra is not None:
        surface = surface - extra
    depth = (surface + np.random.default_rng(seed).normal(0.0, noise_mm, surface.shape)).astype(np.float32)
    valid = np.ones(depth.shape, dtype=bool)
    if hole is not None:
        valid[hole] = False
    return RoiDepth(depth_mm=np.where(valid, depth, np.float32(0.0))[THIN], valid=valid[THIN], stride_px=STRIDE_PX)


def error_mm(model, basis, found, amplitude_mm=4.0, extra=0.0):
    surface = model.mean_mm + np.tensordot(found.coefficients, modes_of(model), axes=1)
    return surface - (REST_MM - amplitude_mm * BREATH - extra)


def cosine_noise(model, basis, noise_mm):
    found = [project(basis, roi(seed=seed, noise_mm=noise_mm), None) for seed in range(12)]
    motions = [np.tensordot(f.coefficients[1:], modes_of(model)[1:], axes=1) for f in found]
    return float(np.std(motions, axis=0).mean())


def test_quiet_breathing_pays_little_noise_for_the_smooth_correction(model, basis):
    widest = prepare_basis(model)
    object.__setattr__(widest, "stiffness", np.repeat(basis.stiffness[-1:], len(PRIOR_SPREADS_MM), axis=0))
    object.__setattr__(widest, "log_stiffness", np.repeat(basis.log_stiffness[-1:], len(PRIOR_SPREADS_MM)))
    assert cosine_noise(model, basis, 1.0) < 0.4 * cosine_noise(model, widest, 1.0)


def test_a_breath_hold_that_was_never_taught_is_followed(model, basis):
    found = project(basis, roi(extra=12.0 * HOLD), None)
    assert np.abs(error_mm(model, basis, found, extra=12.0 * HOLD)).mean() < 0.35
    stiff = prepare_basis(model)
    object.__setattr__(stiff, "stiffness", np.repeat(basis.stiffness[:1] * 1e6, len(PRIOR_SPREADS_MM), axis=0))
    alone = project(stiff, roi(extra=12.0 * HOLD), None)
    assert np.abs(error_mm(model, basis, alone, extra=12.0 * HOLD)).mean() > 1.0


@pytest.mark.parametrize("before_mm", [3.7, 0.0, -20.0])
def test_where_it_starts_from_does_not_matter(model, basis, before_mm):
    start = project(basis, roi(before_mm, seed=8), None).coefficients
    fresh = project(basis, roi(), None)
    followed = project(basis, roi(), start)
    difference = np.tensordot(followed.coefficients - fresh.coefficients, modes_of(model), axes=1)
    assert np.abs(difference).mean() < 0.01
    assert np.abs(difference).max() < 0.04


def test_a_hand_of_a_fifth_of_the_region_has_no_say(model, basis):
    hand = np.zeros(REST_MM.shape)
    hand[100:200, 40:180] = 45.0
    start = project(basis, roi(3.8, seed=3), None).coefficients
    found = project(basis, roi(extra=hand), start)
    outside = hand == 0.0
    assert np.abs(error_mm(model, basis, found)[outside]).mean() < 0.25
    assert found.residual_mm == pytest.approx(float(CHECK_CLIP_MM), abs=0.5)
    assert 0.75 < found.inlier_share < 0.85


def test_one_reading_that_jumped_is_no_region_that_does_not_fit(basis):
    jump = np.zeros(REST_MM.shape)
    jump[120, 80] = 300.0
    assert project(basis, roi(extra=jump), None).residual_mm < project(basis, roi(), None).residual_mm + 0.5


def test_what_a_noisy_sensor_adds_is_taken_off_the_residual_within_a_bound(model, basis):
    """The noise of the mean of a cell of 25 px: 0.3 mm and less take nothing off, nor does any of a finite residual."""
    hand = np.zeros(REST_MM.shape)
    hand[100:200, 40:180] = 45.0
    whole = project(basis, roi(extra=hand), None).residual_mm

    def off_mm(cell_noise_mm):
        noisy = prepare_basis(replace(model, noise_mm=25.0 * cell_noise_mm))
        object.__setattr__(noisy, "variance_mm2", basis.variance_mm2)
        object.__setattr__(noisy, "stiffness", basis.stiffness)
        object.__setattr__(noisy, "log_stiffness", basis.log_stiffness)
        return whole - project(noisy, roi(extra=hand), None).residual_mm

    assert [off_mm(noise) for noise in (0.1, 0.3, 0.7, 0.9, 5.0)] == pytest.approx([0.0, 0.0, 2.8, 4.2, 4.2], abs=0.01)
    quiet = prepare_basis(replace(model, noise_mm=25.0 * 0.9))
    assert project(quiet, roi(), None).residual_mm == 0.0


def test_half_of_the_region_unseen_is_measured_by_the_other_half(model, basis):
    found = project(basis, roi(hole=(slice(None), slice(0, 100))), None)
    assert found.valid_share == pytest.approx(0.5, abs=0.02)
    assert np.abs(error_mm(model, basis, found)[:, 100:]).mean() < 0.2


def test_nothing_seen_is_nothing_found(basis):
    assert project(basis, roi(hole=(slice(None), slice(None))), None) is None


def test_a_region_of_full_resolution_gives_the_same(basis):
    full = (REST_MM - 4.0 * BREATH).astype(np.float32)
    thin = roi(noise_mm=0.0)
    one = project(basis, RoiDepth(depth_mm=full, valid=np.ones(full.shape, dtype=bool)), None)
    other = project(basis, thin, None)
    assert one.coefficients == pytest.approx(other.coefficients, abs=1e-3)


RIGID = {"height": np.ones_like(BREATH), "tilt": 0.5 + ROWS / ROWS.max() + 0.0 * COLUMNS}


@pytest.mark.parametrize("departure", [0.0, 1e-6, 1e-3])
@pytest.mark.parametrize("noise_mm", [0.1, 0.8])
@pytest.mark.parametrize("how", RIGID)
@pytest.mark.parametrize("seen", [1.0, 0.3])
@pytest.mark.parametrize("is_followed", [True, False])
@pytest.mark.parametrize("is_compiled", [True, False])
def test_a_body_that_moves_as_a_whole_is_measured(
    monkeypatch, model, how, departure, noise_mm, seen, is_followed, is_compiled
):
    """Its component is a cosine as well, but for the departure: what a motion platform's training gives."""
    if not is_compiled:
        monkeypatch.setattr(projection.FramePath, "kernels", None)
    shape = RIGID[how] + departure * HOLD
    component = -(shape / np.linalg.norm(shape))[None].astype(np.float32)
    known = ~((np.abs(ROWS - 60.0) < 20.0) & (np.abs(COLUMNS - 80.0) < 20.0))  # a marker's hole
    eigenvalues_mm2 = np.array([8.0 * float((shape**2).sum())])
    rigid = replace(model, components=component, eigenvalues_mm2=eigenvalues_mm2, known=known, noise_mm=noise_mm)
    prepared, start = prepare_basis(rigid), None
    random = np.random.default_rng(2)
    for motion_mm in (*np.linspace(-6.0, 6.0, 7), 0.0):
        truth_mm = rigid.mean_mm - motion_mm * shape
        valid = known & (200 * seen > COLUMNS)
        depth_mm = (truth_mm + random.normal(0.0, noise_mm, truth_mm.shape)).astype(np.float32)
        held = RoiDepth(depth_mm=depth_mm[THIN], valid=valid[THIN], stride_px=STRIDE_PX)
        found = project(prepared, held, start)
        assert found is not None
        start = found.coefficients if is_followed else None
        surface_mm = rigid.mean_mm + np.tensordot(found.coefficients, modes_of(rigid), axes=1)
        assert np.abs(surface_mm - truth_mm)[valid].max() <= noise_mm, "no more than one reading"
        assert found.inlier_share >= 0.99


def test_equations_without_a_solution_are_nothing_found(monkeypatch, basis):
    def fail(*_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(projection.FramePath, "kernels", None)
    monkeypatch.setattr(projection, "_solve", fail)
    assert project(basis, roi(), None) is None
