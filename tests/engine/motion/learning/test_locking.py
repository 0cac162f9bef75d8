"""The sensor's error that is common to all pixels: found, taken off, stored with the model, and not invented."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, ModelError
from engine.core.frames import RoiDepth
from engine.core.locking_curve import LARGEST_PX, LockingCurve, corrected
from engine.motion.learning.locking import find_locking
from engine.motion.learning.model_file import load_model, save_model
from engine.motion.learning.prepared_model import prepare_model
from engine.motion.stages.projection import project
from engine.motion.stages.regions import RegionLayout
from tests.support.motion.fitting_frames import frames, learn

pytestmark = pytest.mark.slow

PIXELS_MM = 43_185.0
"""A Kinect's: hardly the one that the search assumes, as a site's camera is none of our making."""
CURVE = LockingCurve(pixels_mm=PIXELS_MM, cosine_px=(0.02, 0.0), sine_px=(-0.03, 0.0))
NOISE_MM = 1.2
SIGNAL_MM = 4.5 - 4.5 * np.cos(np.linspace(0.0, 12.0 * np.pi, 240))


def sloped(seed=1, signal_mm=SIGNAL_MM):
    """Breathing frames of a surface that slopes, so that every phase occurs, and all points of them valid."""
    depth, valid = frames(NOISE_MM, blur_px=1.3, seed=seed, signal_mm=signal_mm)
    rows = np.arange(depth.shape[1], dtype=np.float32)[:, None]
    return depth + np.float32(0.35) * rows + 0.05 * np.square(rows - 60.0) / 10.0, valid


def read(depth, curve=CURVE, at=1.0):
    return (depth + at * curve.error_mm(depth)).astype(np.float32)


def found(depth, valid):
    return find_locking(depth, valid, valid.all(axis=0), 2, 3)


@pytest.fixture(scope="module")
def honest():
    return sloped()


@pytest.mark.parametrize(("at", "most_mm"), [(1.0, 0.2), (0.4, 0.2), (-1.0, 0.2), (2.0, 0.35)])
def test_a_common_error_is_found_within_a_part_of_a_step(honest, at, most_mm):
    """The strongest is fitted well only after the components have given back their part of it."""
    depth, valid = honest
    curve = found(read(depth, at=at), valid)
    span_mm = np.arange(820.0, 930.0, 0.5)
    left_mm = curve.error_mm(span_mm) - at * CURVE.error_mm(span_mm)
    assert np.sqrt(np.mean(np.square(left_mm))) < most_mm, "a step is 2.1 mm"


def test_a_sensor_without_such_an_error_gets_no_curve(honest):
    assert found(*honest) is None


def test_a_body_at_rest_shows_no_curve():
    depth, valid = sloped(signal_mm=0.02 * SIGNAL_MM)
    assert found(read(depth), valid) is None


def test_a_region_of_hardly_any_depth_gets_no_curve_though_it_moves_as_if_there_were_one():
    depth, valid = frames(NOISE_MM, blur_px=1.3, signal_mm=SIGNAL_MM)
    bent_mm = 0.5 * np.cos(np.linspace(0.0, 24.0 * np.pi, len(depth)))[:, None, None]
    assert found((depth + bent_mm).astype(np.float32), valid) is None


@pytest.mark.parametrize("seed", range(4))
def test_an_error_that_differs_from_place_to_place_is_not_taken_for_a_common_one(honest, seed):
    depth, valid = honest
    rng = np.random.default_rng(seed)
    places = np.kron(rng.standard_normal((2, 35, 13)), np.ones((5, 8)))[:, : depth.shape[1], : depth.shape[2]]
    swings = (replace(CURVE, cosine_px=(0.03, 0.0), sine_px=(0.0, 0.0)), replace(CURVE, cosine_px=(0.0, 0.0)))
    wrong_mm = sum(place * one.error_mm(depth) for place, one in zip(places, swings, strict=True))
    assert found((depth + wrong_mm).astype(np.float32), valid) is None


def moved_mm(model, depth, valid):
    """Motion of the nodes from the end of an exhale to the end of an inhale."""
    active = prepare_model(model, RegionLayout())
    ends = (RoiDepth(depth_mm=depth[i], valid=valid[i], stride_px=2) for i in (0, 20))
    before, after = (active.node_depth_mm(project(active.basis, one, None).coefficients) for one in ends)
    return after - before


def test_what_a_model_measures_follows_the_body_not_the_curve(honest, monkeypatch):
    depth, valid = honest
    true_mm = moved_mm(learn(depth, valid), depth, valid)
    wrong = read(depth)
    errors_mm = [moved_mm(learn(wrong, valid), wrong, valid) - true_mm]
    monkeypatch.setattr("engine.motion.learning.fitting.find_locking", lambda *_: None)
    errors_mm.append(moved_mm(learn(wrong, valid), wrong, valid) - true_mm)
    with_curve, without = (float(np.sqrt(np.mean(np.square(one)))) for one in errors_mm)
    assert with_curve < 0.5 * without


def test_the_table_takes_off_what_the_curve_says_and_keeps_its_end_beyond():
    depth = np.array([299.0, 300.0, 850.2, 1699.0, 9000.0], dtype=np.float32)
    table = CURVE.table_mm()
    error_mm = CURVE.error_mm(depth)
    off = depth - corrected(depth, table)
    assert off[1:4] == pytest.approx(error_mm[1:4], abs=0.02)
    assert (off[0], off[4]) == pytest.approx((table[0], table[-1]), abs=1e-3)
    without = corrected(np.array([np.nan, 0.0, -np.inf, np.inf], dtype=np.float32), table)
    assert np.isnan(without[0])
    assert np.isfinite(without[1])


def test_a_swing_beyond_what_a_matching_makes_is_not_taken_off(honest, monkeypatch):
    depth, valid = honest
    monkeypatch.setattr("engine.motion.learning.locking.LARGEST_PX", 0.02)
    assert found(read(depth), valid) is None


def test_a_curve_survives_the_model_s_file_and_one_without_is_read_as_none(honest, tmp_path):
    depth, valid = honest
    for number, model in enumerate((learn(read(depth), valid), learn(depth, valid))):
        path = tmp_path / f"{number}.npz"
        save_model(model, path)
        assert load_model(path).locking == model.locking
        assert (model.locking is None) is (number == 1)


def test_a_file_with_an_impossible_curve_is_refused(honest, tmp_path):
    depth, valid = honest
    model = learn(read(depth), valid)
    object.__setattr__(model.locking, "sine_px", (LARGEST_PX + 0.01, 0.0))
    save_model(model, tmp_path / "model.npz")
    with pytest.raises(ModelError, match=r"locking.sine_px"):
        load_model(tmp_path / "model.npz")
    for wrong in ({"cosine_px": (LARGEST_PX + 0.01, 0.0)}, {"sine_px": (0.0,)}, {"pixels_mm": 0.0}):
        with pytest.raises(InvalidValueError, match="locking"):
            replace(CURVE, **wrong)
