"""Breathing, a rigid movement and anything else are distinguished on measured cell means."""

from types import SimpleNamespace

import numpy as np
import pytest

from engine.core.frames import RoiDepth
from engine.motion.cross_check.cell_surface import (
    CELL_COLUMNS,
    CELL_ROWS,
    CELLS,
    LEAST_CELLS,
    LEAST_FRAMES,
    cell_means,
    learn_shapes,
    shapes_of,
)

ROWS, COLUMNS = np.mgrid[0:CELL_ROWS, 0:CELL_COLUMNS].reshape(2, -1)
ALONG, ACROSS = (2.0 * ROWS + 1.0) / CELL_ROWS - 1.0, (2.0 * COLUMNS + 1.0) / CELL_COLUMNS - 1.0
CHEST, BELLY = np.exp(-((ALONG + 0.6) ** 2) * 3.0), np.exp(-((ALONG - 0.5) ** 2) * 4.0 - ACROSS**2)
REST_MM = 850.0 + 20.0 * ACROSS**2
NOISE_MM = 0.15


def surfaces_mm(seconds=12.0, seed=1):
    """Surfaces of free breathing at 30 frames a second, with the noise of a cell's mean."""
    time_s = np.arange(0.0, seconds, 1.0 / 30.0)
    chest, belly = 2.0 - 2.0 * np.cos(1.5 * time_s - 0.4), 5.0 - 5.0 * np.cos(1.5 * time_s)
    noise = np.random.default_rng(seed).normal(0.0, NOISE_MM, (len(time_s), CELLS))
    return REST_MM - chest[:, None] * CHEST - belly[:, None] * BELLY + noise


SHAPES = learn_shapes(surfaces_mm())
BEFORE, AFTER = surfaces_mm(seed=2)[[3, 50]]


def test_breathing_leaves_the_noise_and_no_rigid_movement():
    change = SHAPES.change(BEFORE, AFTER)
    assert change.spread_mm < 2.0 * NOISE_MM
    assert max(abs(change.height_mm), abs(change.along_mm), abs(change.across_mm)) < 0.5


@pytest.mark.parametrize(
    ("height_mm", "along_mm", "across_mm"), [(4.0, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, 3.0, 0.0), (1.0, -2.0, 5.0)]
)
def test_a_rigid_movement_between_two_moments_of_the_breath_is_measured(height_mm, along_mm, across_mm):
    moved = AFTER - height_mm - along_mm * ALONG - across_mm * ACROSS
    change = SHAPES.change(BEFORE, moved)
    found = [change.height_mm, change.along_mm, change.across_mm]
    assert found == pytest.approx([height_mm, along_mm, across_mm], abs=0.5)
    assert change.spread_mm < 2.0 * NOISE_MM


@pytest.mark.parametrize("is_covered", [ALONG > 0.0, ACROSS > 0.0, np.abs(ALONG) < 0.4], ids=["half", "side", "middle"])
def test_an_object_is_neither_breathing_nor_rigid(is_covered):
    covered = AFTER - 3.0 * is_covered
    assert SHAPES.change(BEFORE, covered).spread_mm > 2.5 * SHAPES.misfit_mm > NOISE_MM


def test_cells_that_are_not_seen_are_not_compared():
    hidden = np.where(np.arange(CELLS) < 30, np.nan, AFTER - 4.0)
    change = SHAPES.change(BEFORE, hidden)
    assert np.isnan(change.misfit_mm[:30]).all()
    assert change.height_mm == pytest.approx(4.0, abs=0.6)
    assert SHAPES.change(BEFORE, np.where(np.arange(CELLS) < LEAST_CELLS - 1, AFTER, np.nan)) is None


def test_too_few_frames_or_cells_teach_nothing():
    surfaces = surfaces_mm()
    assert learn_shapes(surfaces[: LEAST_FRAMES - 1]) is None
    assert learn_shapes(np.where(np.arange(CELLS) < LEAST_CELLS - 1, surfaces, np.nan)) is None
    assert learn_shapes(np.empty((0,))) is None


def test_a_stored_models_components_serve_where_no_training_was_seen():
    rows, columns = np.mgrid[0:350, 0:200]
    along, across = rows / 175.0 - 1.0, columns / 100.0 - 1.0
    components = np.stack([np.exp(-((along + 0.6) ** 2) * 3.0), np.exp(-((along - 0.5) ** 2) * 4.0 - across**2)])
    scores_mm = np.array([[-500.0, 0.0], [800.0, 10.0]])
    model = SimpleNamespace(components=components.astype(np.float32), noise_mm=3.0, scores_mm=scores_mm)
    shapes = shapes_of(model)
    assert shapes.change(BEFORE, AFTER - 4.0).height_mm == pytest.approx(4.0, abs=0.5)
    assert shapes.misfit_mm == pytest.approx(3.0 / np.sqrt(350 * 200 / CELLS))
    assert shapes.reach_mm == pytest.approx(1300.0 / np.sqrt(350 * 200))
    model.components, model.scores_mm = model.components[:1], None
    assert shapes_of(model).shapes.shape == shapes.shapes.shape
    assert shapes_of(model).reach_mm == np.inf


def test_the_reach_is_that_of_the_breaths():
    assert SHAPES.reach_mm == pytest.approx(SHAPES.change(BEFORE, AFTER).breath_mm, rel=0.5)
    deeper = REST_MM - 10.0 * CHEST - 30.0 * BELLY
    assert SHAPES.change(BEFORE, deeper).breath_mm > 2.0 * SHAPES.reach_mm


def test_the_mean_of_a_cell_is_that_of_its_readings():
    rows, columns = np.mgrid[0:88, 0:50]
    depth_mm = (800.0 + rows + 0.1 * columns).astype(np.float32)
    valid = np.ones(depth_mm.shape, dtype=bool)
    valid[:4, :5] = False
    means = cell_means(RoiDepth(depth_mm=np.where(valid, depth_mm, 0.0).astype(np.float32), valid=valid, stride_px=4))
    assert means.shape == (CELLS,)
    assert means[0] == pytest.approx(depth_mm[4:11, :5].mean())
    assert means[-1] == pytest.approx(depth_mm[77:, 45:].mean())
    hidden = np.zeros(depth_mm.shape, dtype=bool)
    hidden[11:] = True
    assert np.isnan(cell_means(RoiDepth(depth_mm=depth_mm, valid=hidden, stride_px=4))[:CELL_COLUMNS]).all()
