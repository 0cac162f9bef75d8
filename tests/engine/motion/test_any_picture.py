"""Whatever the cameras show, each frame is measured, learned from, or lost with a reason; nothing raises."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.calibration.quantisation import DEPTH_VALUES, depth_table_mm, find_steps
from engine.core.clock import ManualClock
from engine.core.frames import LostReason, MeasurementState, RgbdFrame
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.motion.stages.roi import cut_out, roi_nodes
from engine.motion.tracking.region_tracker import COUNTED_FRAMES
from tests.support.motion import arbitrary_pictures, small_scene

pytestmark = [pytest.mark.slow, pytest.mark.verification]

SETTINGS = PipelineSettings(
    training=TrainingSettings(min_frames=40, min_seconds=4.0, min_cycles=1, max_seconds=20.0), extra_markers=True
)
SEEDS = st.integers(0, 2**32 - 1)
KINECT_SIZE = (640, 480)


def new_pipeline(calibration=small_scene.CALIBRATION):
    return Pipeline(calibration, SETTINGS, ManualClock(), InlineTrainer())


def frame_of(index, depth_mm, color):
    time_us = index * small_scene.FRAME_US
    return RgbdFrame(
        index=index,
        device_index=index,
        timestamp_us=time_us,
        color_timestamp_us=time_us,
        received_ns=time_us * 1000,
        depth_mm=depth_mm,
        color=small_scene.numbered(color, index),
    )


def measured(pipeline, frame):
    outcome = pipeline.measure(frame)
    arbitrary_pictures.check(outcome, frame)
    return outcome


@pytest.fixture(scope="module")
def clean():
    """A breath of the scene's patient."""
    return [small_scene.frame(index) for index in range(120)]


@pytest.fixture(scope="module")
def learned(clean):
    """A model of that patient, learned once."""
    pipeline = new_pipeline()
    for index in itertools.count():
        frame = frame_of(index, clean[index % 120].depth_mm, clean[index % 120].color)
        if pipeline.measure(frame).state is MeasurementState.MEASURING:
            return pipeline.learner.status.model
    return None


def test_a_room_at_any_distance_is_lost_for_its_markers(subtests):
    for distance_mm in (*range(1, 40), *range(40, 1000, 40), *range(1000, 10_000, 97), 65_535):
        with subtests.test(f"{distance_mm} mm"):
            color = np.random.default_rng(distance_mm).integers(0, 256, (480, 640, 3), np.uint8)
            outcome = measured(new_pipeline(), frame_of(0, np.full((480, 640), distance_mm, np.uint16), color))
            assert outcome.lost.reason is LostReason.MARKER_LOST


def test_a_room_four_metres_away_is_lost_and_the_reason_states_how_far_it_is():
    focal_px = 525.0
    camera = replace(small_scene.CAMERA, fx=focal_px, fy=focal_px)
    pipeline = new_pipeline(replace(small_scene.CALIBRATION, depth=camera, color=camera))
    rng = np.random.default_rng(0)
    for index in range(2 * COUNTED_FRAMES):
        depth = rng.integers(4_050, 4_150, (480, 640)).astype(np.uint16)
        outcome = measured(pipeline, frame_of(index, depth, arbitrary_pictures.COLORS["salt"](rng, (480, 640))))
        assert outcome.lost.reason is LostReason.MARKER_LOST
        assert outcome.lost.detail.startswith("the object in view is 4")
        assert "2.6 px wide" in outcome.lost.detail


def test_a_patient_is_found_at_the_first_frame_after_an_empty_room(clean):
    pipeline = new_pipeline()
    room = np.full((480, 640), 4_100, np.uint16)
    for index in range(COUNTED_FRAMES):
        assert measured(pipeline, frame_of(index, room, clean[0].color)).state is MeasurementState.LOST
    patient = frame_of(COUNTED_FRAMES, clean[0].depth_mm, clean[0].color)
    assert measured(pipeline, patient).state is MeasurementState.TRAINING


def test_a_distance_that_came_to_be_impossible_is_asked_of_the_next_picture(clean):
    """The region's depth was followed to where no marker can be seen; the camera sees the patient again."""
    pipeline = new_pipeline()
    far = np.full((480, 640), 65_535, np.uint16)
    edge = (slice(160, 320), slice(213, 427))
    # The middle says that a patient may be there, the rest of the region is followed to 65 m.
    deceptive = far.copy()
    deceptive[edge] = 850
    for index in range(40):
        measured(pipeline, frame_of(index, deceptive if index < 2 else far, clean[0].color))
    states = [
        measured(pipeline, frame_of(40 + index, clean[index].depth_mm, clean[0].color)).state for index in range(3)
    ]
    assert states[-1] is MeasurementState.TRAINING


@pytest.mark.parametrize("factor", [0.3, 2.5, 6.0, 30.0])
def test_one_bad_depth_picture_before_there_is_a_model_does_not_lose_the_patient_for_good(clean, factor):
    """The distance that is followed is led astray by it, and with it the size of the markers looked for."""
    pipeline = new_pipeline()
    states = []
    for index in range(12):
        depth = clean[index].depth_mm
        if index in (5, 6, 7):
            depth = np.minimum(depth * factor, arbitrary_pictures.FARTHEST_READING).astype(np.uint16)
        states.append(measured(pipeline, frame_of(index, depth, clean[index].color)).state)
    assert states[-1] is MeasurementState.TRAINING


@given(
    seed=SEEDS,
    depth_size=st.tuples(st.integers(160, 330), st.integers(120, 250)),
    color_size=st.tuples(st.integers(160, 330), st.integers(120, 250)),
    focal_share=st.floats(0.3, 5.0),
    baseline_mm=st.sampled_from([0.0, 60.0, -200.0]),
    depths=st.lists(st.sampled_from(sorted(arbitrary_pictures.DEPTHS)), min_size=1, max_size=6),
    colors=st.lists(st.sampled_from(sorted(arbitrary_pictures.COLORS)), min_size=1, max_size=6),
)
@settings(max_examples=60, deadline=None)
def test_no_picture_of_any_size_ends_the_measuring(
    seed, depth_size, color_size, focal_share, baseline_mm, depths, colors
):
    rng = np.random.default_rng(seed)
    calibration = arbitrary_pictures.calibration(
        depth_size, color_size, focal_share=focal_share, baseline_mm=baseline_mm
    )
    pipeline = new_pipeline(calibration)
    kinds = zip(itertools.cycle(depths), itertools.cycle(colors), range(COUNTED_FRAMES + 4), strict=False)
    for depth_kind, color_kind, index in kinds:
        depth = arbitrary_pictures.DEPTHS[depth_kind](rng, depth_size[::-1])
        color = arbitrary_pictures.COLORS[color_kind](rng, color_size[::-1])
        measured(pipeline, frame_of(index, depth, color))


@given(seed=SEEDS, damaged_share=st.floats(0.05, 1.0), has_model=st.booleans())
@settings(max_examples=25, deadline=None)
def test_no_damage_to_a_patients_frames_ends_the_measuring(learned, clean, seed, damaged_share, has_model):
    rng = np.random.default_rng(seed)
    pipeline = new_pipeline()
    if has_model:
        pipeline.learner.activate(learned)
    for index in range(COUNTED_FRAMES + 20):
        frame = frame_of(index, clean[index].depth_mm, clean[index].color)
        is_damaged = rng.random() < damaged_share
        measured(pipeline, arbitrary_pictures.damaged(rng, frame) if is_damaged else frame)


def test_damaged_frames_among_those_that_are_learned_end_neither_the_learning_nor_the_measuring(clean):
    rng = np.random.default_rng(11)
    pipeline = new_pipeline()
    states = []
    for index in range(500):
        frame = frame_of(index, clean[index % 120].depth_mm, clean[index % 120].color)
        is_damaged = index < 100 and rng.random() < 0.2
        states.append(measured(pipeline, arbitrary_pictures.damaged(rng, frame) if is_damaged else frame).state)
        if states[-1] is MeasurementState.MEASURING:
            break
    assert set(states) == set(MeasurementState)


@pytest.mark.parametrize("coordinate", [np.nan, np.inf, -np.inf, 1e12, -1e12])
def test_a_region_beside_or_behind_the_depth_camera_is_not_seen(clean, coordinate):
    nodes_px = roi_nodes(small_scene.CORNERS_PX)
    nodes_px[5] = coordinate
    roi = cut_out(clean[0].depth_mm, nodes_px, depth_table_mm(None), 4)
    assert roi.valid.any() == np.isfinite(coordinate)
    assert not roi.valid.all()
    assert np.isfinite(roi.depth_mm).all()


@given(seed=SEEDS, count=st.integers(0, 950))
@settings(max_examples=60, deadline=None)
def test_no_set_of_depth_levels_ends_the_search_for_the_sensors_steps(seed, count):
    rng = np.random.default_rng(seed)
    counts = np.zeros(DEPTH_VALUES, dtype=np.int64)
    spread = rng.choice([50, 200, 951])
    counts[rng.integers(450, 450 + spread, count)] = 100
    assert np.isfinite(depth_table_mm(find_steps(counts))[1:]).all()
