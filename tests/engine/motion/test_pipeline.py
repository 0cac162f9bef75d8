"""The pipeline learns, measures, says when it cannot, and never moves zero by itself."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from engine.core.clock import ManualClock
from engine.core.errors import CalibrationError, CommandRefusedError, ModelError
from engine.core.frames import LostReason, MeasurementState
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.motion.tracking.region_tracker import COUNTED_FRAMES
from tests.support.motion import small_scene

pytestmark = pytest.mark.slow

SETTINGS = PipelineSettings(
    points=((90, 100), (280, 100)),
    training=TrainingSettings(min_frames=40, min_seconds=4.0, min_cycles=2, max_seconds=20.0),
)


def new_pipeline(settings=SETTINGS):
    return Pipeline(small_scene.CALIBRATION, settings, ManualClock(), InlineTrainer())


def measure(pipeline, indices, **kwargs):
    return [pipeline.measure(small_scene.frame(i, **kwargs)) for i in indices]


@pytest.fixture(scope="module")
def learned():
    """A model, learned once; each test gets a pipeline of its own around it."""
    pipeline = new_pipeline()
    for index in itertools.count():
        if pipeline.measure(small_scene.frame(index)).state is MeasurementState.MEASURING:
            return pipeline.learner.status.model
    return None


@pytest.fixture
def measuring(learned):
    """A pipeline that measures; its reference is frame 0, as it and the frames before it say."""
    pipeline = new_pipeline()
    pipeline.learner.activate(learned)
    before = measure(pipeline, range(1 - COUNTED_FRAMES, 0))
    assert {measurement.state for measurement in before} == {MeasurementState.TRAINING}
    assert measure(pipeline, [0])[0].motion.whole_mm == pytest.approx(0.0, abs=0.05)
    return pipeline


@pytest.mark.parametrize("is_asked", [True, False], ids=["asked", "with the next frame"])
def test_a_frame_that_is_learned_from_later_gives_the_same(is_asked):
    """The models and the proposed references are the same, a frame later."""
    at_once = new_pipeline()
    later = Pipeline(small_scene.CALIBRATION, SETTINGS, ManualClock(), InlineTrainer(), learns_after=True)
    for index in range(600):
        frame = small_scene.frame(index)
        expected, found = at_once.measure(frame), later.measure(frame)
        if is_asked:
            later.learn()
        assert found.state is expected.state
        if expected.motion is not None:
            assert found.motion.whole_mm == expected.motion.whole_mm
    later.learn()
    assert later.learner.status.model_generation == at_once.learner.status.model_generation >= 1
    proposed, wanted = (one.learner.status.reference_proposals for one in (later, at_once))
    assert [one.moment for one in proposed] == [one.moment for one in wanted] != []
    assert [one.level for one in proposed] == [one.level for one in wanted]


def test_it_trains_until_frames_time_and_cycles_are_there_then_measures():
    pipeline = new_pipeline()
    states, progress = [], []
    for index in range(400):
        measurement = pipeline.measure(small_scene.frame(index))
        states.append(measurement.state)
        progress.append(measurement.training)
        if measurement.state is MeasurementState.MEASURING:
            break
    trained = len(states) - 1
    assert set(states[:trained]) == {MeasurementState.TRAINING}
    assert trained * small_scene.FRAME_US / 1e6 > 8.0  # two complete cycles of four seconds
    assert pipeline.learner.status.model.cycles >= 2
    shares = [item.share for item in progress[: trained - 1]]
    assert shares == sorted(shares)
    assert progress[trained] is None


def test_whole_motion_is_true_to_a_tenth_of_a_millimetre_and_inhale_is_positive(measuring):
    indices = [10, 30, 60, 75]
    motions = [m.motion.whole_mm for m in measure(measuring, indices)]
    truth = [small_scene.whole_motion_mm(i, 0) for i in indices]
    assert max(truth) > 3.0
    assert np.abs(np.array(motions) - truth).max() < 0.12


def test_points_and_regions_agree_with_the_parts(measuring):
    motion = measure(measuring, [60])[0].motion
    assert motion.regions_mm.shape == (14, 8)
    assert motion.whole_mm == pytest.approx(motion.regions_mm.mean(), abs=1e-6)
    assert motion.whole_mm == pytest.approx((motion.thorax_mm + motion.abdomen_mm) / 2, abs=1e-6)
    assert motion.points_mm[1] > motion.points_mm[0] > 0.0
    assert motion.volume_l > 0.05


def test_a_hidden_marker_is_lost_at_that_frame_and_found_again(measuring):
    hidden = small_scene.CORNERS_PX[[0, 1, 2]]
    lost = measuring.measure(small_scene.frame(5, corners_px=hidden))
    assert lost.state is MeasurementState.LOST
    assert lost.lost.reason is LostReason.MARKER_LOST
    assert lost.motion is None
    assert measure(measuring, [6])[0].state is MeasurementState.MEASURING


@pytest.mark.parametrize(("gap_ms", "state"), [(90, MeasurementState.MEASURING), (110, MeasurementState.LOST)])
def test_markers_of_a_colour_stream_that_stands_still_are_not_trusted(measuring, gap_ms, state):
    good = small_scene.frame(60)
    outcome = measuring.measure(replace(good, color_timestamp_us=good.timestamp_us - gap_ms * 1000))
    assert outcome.state is state


def test_a_layout_that_changed_is_lost(learned):
    pipeline = new_pipeline()
    measure(pipeline, range(COUNTED_FRAMES + 1))
    moved = small_scene.CORNERS_PX.copy()
    moved[3] += (0.0, 40.0)
    moved[2] += (0.0, 38.0)
    outcome = pipeline.measure(small_scene.frame(COUNTED_FRAMES + 1, corners_px=moved))
    assert outcome.lost.reason is LostReason.LAYOUT_CHANGED


def test_a_sheet_over_the_region_is_lost_not_measured(measuring):
    def sheet(depth):
        depth[60:300, 150:500] -= 80

    outcome = measuring.measure(small_scene.frame(5, edit=sheet))
    assert outcome.state is MeasurementState.LOST
    assert outcome.lost.reason is LostReason.RESIDUAL_HIGH


def test_a_thin_sheet_that_would_pass_for_motion_is_lost_until_it_is_gone(measuring):
    def sheet(depth):
        depth[200:300, 270:370] -= 5

    assert measure(measuring, [1])[0].state is MeasurementState.MEASURING
    covered = measure(measuring, range(2, 20), edit=sheet)
    assert {outcome.state for outcome in covered} == {MeasurementState.LOST}
    assert "objects on the patient" in covered[-1].lost.detail
    assert measure(measuring, range(20, 28))[-1].state is MeasurementState.MEASURING


def test_a_person_who_sets_the_reference_takes_the_sheet_for_granted(measuring):
    def sheet(depth):
        depth[200:300, 270:370] -= 5

    measure(measuring, [1])
    assert measure(measuring, [2], edit=sheet)[0].state is MeasurementState.LOST
    measuring.learner.set_reference()
    assert measure(measuring, [3], edit=sheet)[0].state is MeasurementState.MEASURING


def test_a_small_hand_does_not_bend_the_motion(measuring):
    def hand(depth):
        depth[200:240, 300:340] -= 70

    clean = measure(measuring, [20])[0].motion
    measure(measuring, [20])
    outcome = measuring.measure(small_scene.frame(20, edit=hand))
    if outcome.motion is None:
        assert outcome.lost.reason is LostReason.RESIDUAL_HIGH
    else:
        assert outcome.motion.whole_mm == pytest.approx(clean.whole_mm, abs=0.1)
        assert outcome.motion.projection.residual_mm > 10.0


def test_a_blinded_camera_is_lost(measuring):
    def blind(depth):
        depth[:] = 0

    outcome = measuring.measure(small_scene.frame(5, edit=blind))
    assert outcome.lost.reason is LostReason.COVERAGE_LOW


def test_an_old_picture_is_lost_and_the_next_new_one_measured(measuring):
    """Its values are those of another moment, wherever its time stands."""
    old = [replace(small_scene.frame(index), depth_mm=small_scene.frame(5).depth_mm.copy()) for index in (6, 7)]
    outcomes = [measuring.measure(one) for one in (small_scene.frame(5), *old, small_scene.frame(8))]
    assert [one.lost and one.lost.reason for one in outcomes] == [None, *[LostReason.FRAME_FROZEN] * 2, None]
    assert [one.motion is None for one in outcomes] == [False, True, True, False]


def test_old_pictures_teach_nothing():
    pipeline = new_pipeline()
    first = pipeline.measure(small_scene.frame(0))
    shown = small_scene.frame(0)
    for index in range(1, 200):
        again = replace(small_scene.frame(index), depth_mm=shown.depth_mm.copy(), color=shown.color.copy())
        outcome = pipeline.measure(again)
        assert outcome.lost.reason is LostReason.FRAME_FROZEN
    assert outcome.training.frames == first.training.frames


def test_half_holes_are_measured_and_reported(measuring):
    def holes(depth):
        depth[150:260, 250:400] = 0

    clean = measure(measuring, [30])[0].motion
    outcome = measuring.measure(small_scene.frame(31, excursion=small_scene.breath(30), edit=holes))
    assert outcome.state is MeasurementState.MEASURING
    assert outcome.motion.projection.valid_share < 0.75
    assert outcome.motion.whole_mm == pytest.approx(clean.whole_mm, abs=0.1)


def test_retraining_moves_neither_reference_nor_sign(measuring):
    before = measure(measuring, [60])[0].motion
    generation = measuring.learner.status.model_generation
    first_model = measuring.learner.status.model
    measuring.learner.retrain()
    index = 100
    while measuring.learner.status.model is first_model:
        assert measuring.measure(small_scene.frame(index)).state is MeasurementState.MEASURING
        index += 1
        assert index < 600
    while (index - 60) % 120 != 0:  # whole breaths later
        measuring.measure(small_scene.frame(index))
        index += 1
    after = measuring.measure(small_scene.frame(index, excursion=small_scene.breath(60))).motion
    assert measuring.learner.status.model_generation != generation
    assert after.whole_mm == pytest.approx(before.whole_mm, abs=0.05)


def test_set_reference_makes_the_next_frame_zero_and_reports_the_gate(measuring):
    assert measure(measuring, range(1, 20))[-1].motion.whole_mm > 0.1
    generation = measuring.learner.status.model_generation
    measuring.learner.set_reference()
    assert not measuring.learner.status.has_reference
    assert measure(measuring, [20])[0].motion.whole_mm == pytest.approx(0.0, abs=0.05)
    assert measuring.learner.status.has_reference
    assert measuring.learner.status.model_generation != generation


def test_a_reference_without_a_model_is_refused():
    with pytest.raises(CommandRefusedError, match="model"):
        new_pipeline().learner.set_reference()


def test_a_model_of_another_calibration_is_refused(learned):
    pipeline = new_pipeline()
    with pytest.raises(ModelError, match="calibration"):
        pipeline.learner.activate(replace(learned, calibration_sha256="1" * 64))


def test_pictures_of_another_size_than_the_calibration_are_refused(measuring):
    good = small_scene.frame(5)
    with pytest.raises(CalibrationError, match=r"depth\.width is 640: must be 320"):
        measuring.measure(replace(good, depth_mm=good.depth_mm[:, ::2].copy()))
    with pytest.raises(CalibrationError, match=r"color\.height is 480: must be 240"):
        measuring.measure(replace(good, color=good.color[::2].copy()))


def test_the_same_frames_give_the_same_numbers():
    def run():
        pipeline = new_pipeline()
        return [pipeline.measure(small_scene.frame(i)) for i in range(0, 360, 2)]

    first, second = run(), run()
    assert [m.state for m in first] == [m.state for m in second]
    pairs = [(a.motion, b.motion) for a, b in zip(first, second, strict=True) if a.motion is not None]
    assert pairs
    assert all(np.array_equal(a.regions_mm, b.regions_mm) and a.volume_l == b.volume_l for a, b in pairs)


def test_a_patient_who_never_breathes_regularly_still_gets_a_model_that_states_it():
    settings = PipelineSettings(training=TrainingSettings(min_frames=40, min_seconds=2.0, max_seconds=3.0))
    pipeline = new_pipeline(settings)
    for index in range(200):
        last = pipeline.measure(small_scene.frame(index))
        if last.state is MeasurementState.MEASURING:
            break
    assert pipeline.learner.status.model.cycles < 3
    assert "3 are needed" in pipeline.learner.status.model_shortcoming


def test_a_model_of_enough_cycles_has_no_shortcoming(measuring):
    assert measuring.learner.status.model_shortcoming is None


def test_a_loss_names_each_marker_that_is_not_seen():
    pipeline = new_pipeline()
    measure(pipeline, range(2))
    three, two, none = (
        measure(pipeline, [number], corners_px=small_scene.CORNERS_PX[list(seen)])[0].reason.detail
        for number, seen in ((2, (0, 1, 3)), (3, (1, 3)), (4, []))
    )
    assert three == "3 of 4 markers found: the inferior left marker is hidden or gone"
    assert two == "2 of 4 markers found: markers hidden or gone: superior right, inferior left"
    assert none == "0 of 4 markers found: no marker is near its last position"
