"""What the pipeline says of motion besides the whole: named regions, phase lags, the surface, the patient's split."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from engine.core.clock import ManualClock
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, MeasurementState
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.named_regions import NamedRegion
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.motion.stages.roi import color_from_roi
from engine.motion.stages.surface import surface_mesh
from engine.motion.tracking.costal_line import find_split
from tests.support.motion import small_scene

pytestmark = pytest.mark.slow

TRAINING = TrainingSettings(min_frames=40, min_seconds=4.0, min_cycles=2, max_seconds=20.0)
CELL = NamedRegion(name="cell", vertices=((249.5, 99.5), (249.5, 124.5), (274.5, 124.5), (274.5, 99.5)))
WEDGE = NamedRegion(name="wedge", vertices=((200.0, 30.0), (260.0, 170.0), (330.0, 100.0)))
# Where the scene's side edges are, 0.45 and 0.55 of the way down.
EXTRA_PX = np.array([[240.0 + 0.45 * 5.0, 110.0 + 0.45 * 270.0], [400.0 - 0.55 * 5.0, 110.0 + 0.55 * 270.0]])


def run(settings, *, step, measured, extra_px=None, model=None):
    """Measure every ``step``-th frame of the scene until so many were measured."""
    pipeline = Pipeline(small_scene.CALIBRATION, settings, ManualClock(), InlineTrainer())
    if model is not None:
        pipeline.learner.activate(model)
    motions = []
    for index in range(0, 900, step):
        frame = small_scene.frame(index)
        if extra_px is not None:
            color = small_scene.picture(np.concatenate([small_scene.CORNERS_PX, extra_px]))
            frame = replace(frame, color=small_scene.numbered(color, index))
        outcome = pipeline.measure(frame)
        if outcome.state is MeasurementState.MEASURING:
            motions.append(outcome.motion)
        if len(motions) == measured:
            return pipeline, motions
    raise AssertionError(outcome)


@pytest.fixture(scope="module")
def learned():
    """A pipeline and nine seconds of motion that it measured at ten frames a second."""
    return run(PipelineSettings(named=(CELL, WEDGE), points=((10, 10),), training=TRAINING), step=3, measured=95)


@pytest.fixture(scope="module")
def motions(learned):
    return learned[1]


def test_named_regions_are_measured_in_the_order_given(motions):
    for motion in motions[::20]:
        assert motion.named_mm.shape == (2,)
        assert motion.named_mm[0] == pytest.approx(motion.regions_mm[10, 4], abs=1e-3)
    excursion = np.ptp([motion.named_mm for motion in motions], axis=0)
    assert excursion[0] > excursion[1] > 3.0  # the wedge reaches out to where the belly moves less


def test_a_named_region_is_zero_at_the_reference_as_everything_is(motions):
    assert np.abs(motions[0].named_mm).max() < 1e-9


def test_thorax_against_abdomen_comes_first_then_each_named_region_against_the_whole(motions):
    lags = motions[-1].lags
    assert [(lag.first, lag.second) for lag in lags] == [("thorax", "abdomen"), ("cell", "whole"), ("wedge", "whole")]
    assert motions[0].lags[0].note == "nothing seen yet"


def test_the_lag_is_the_scenes(motions):
    # The chest follows the belly by 0.3 rad of a cycle of four seconds; each half of the region sees some of both.
    lag = motions[-1].lags[0]
    assert lag.period_s == pytest.approx(4.0, abs=0.1)
    assert 0.04 < lag.lag_s < 4.0 * 0.3 / (2.0 * np.pi) + 0.02
    assert lag.confidence > 0.95
    assert abs(motions[-1].lags[1].lag_s) < 0.1


def test_the_surface_is_the_patients_in_the_depth_cameras_frame(motions):
    surface = motions[-1].surface_mm
    assert surface.shape == (NODE_ROWS * NODE_COLUMNS, 3)
    assert np.abs(surface[:, 2] - 845.0).max() < 25.0
    corners = surface.reshape(NODE_ROWS, NODE_COLUMNS, 3)[[0, 0, -1, -1], [0, -1, -1, 0]]
    seen_px = small_scene.CAMERA.project(corners)
    assert np.abs(seen_px - small_scene.CORNERS_PX).max() < 0.3
    mesh = surface_mesh(surface, NODE_ROWS, NODE_COLUMNS)
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0.0).all()
    with pytest.raises(ValueError, match="read-only"):
        surface[0, 0] = 0.0


def test_more_volume_is_a_surface_nearer_to_the_camera(motions):
    volumes = [motion.volume_l for motion in motions]
    depths = [motion.surface_mm[:, 2].mean() for motion in motions]
    assert np.corrcoef(volumes, depths)[0, 1] < -0.999


def test_the_split_is_the_middle_unless_requested_otherwise(motions):
    assert motions[-1].split_rows == (174.5, 174.5)


def test_a_given_line_moves_what_counts_as_thorax(learned):
    _, given = run(PipelineSettings(split=(100.0, 140.0)), step=15, measured=6, model=learned[0].learner.status.model)
    assert given[-1].split_rows == (100.0, 140.0)
    share = (120.0 + 0.5) / 350.0
    for motion in given:
        assert motion.whole_mm == pytest.approx(share * motion.thorax_mm + (1 - share) * motion.abdomen_mm, abs=1e-6)


def test_the_patients_own_stickers_part_thorax_from_abdomen():
    pipeline, marked = run(
        PipelineSettings(extra_markers=True, training=TRAINING), step=4, measured=3, extra_px=EXTRA_PX
    )
    assert marked[-1].split_rows == pytest.approx(find_split(EXTRA_PX, color_from_roi(small_scene.CORNERS_PX)), abs=0.5)
    assert pipeline.marked_split == marked[-1].split_rows
    assert {motion.split_rows for motion in marked} == {marked[0].split_rows}


def test_stickers_that_are_not_there_leave_the_line_where_it_was():
    settings = PipelineSettings(extra_markers=True, thorax_rows=160, training=TRAINING)
    pipeline, motions = run(settings, step=4, measured=1)
    assert pipeline.marked_split is None
    assert motions[-1].split_rows == (159.5, 159.5)


def test_the_scene_shows_what_the_tests_say():
    picture = small_scene.picture(np.concatenate([small_scene.CORNERS_PX, EXTRA_PX]))
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    assert cv2.connectedComponents((gray > 120).astype(np.uint8))[0] - 1 == 6
