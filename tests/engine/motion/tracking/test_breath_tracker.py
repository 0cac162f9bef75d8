"""Breath in the pipeline: with every measured frame, none with a lost one, and no event by what the measuring does."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.frames import MeasurementState
from engine.motion.settings import PipelineSettings
from engine.motion.tracking.breath_tracker import BreathTracker
from tests.support.gating.streams import motion_of
from tests.support.motion.breathing_traces import kinds
from tests.support.motion.scene_session import CHOICES, SceneSession, scene_frames, session_after

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def frames():
    return scene_frames()


@pytest.fixture
def patient():
    return session_after(760)


def test_breaths_come_with_measured_frames_one_a_signal_in_order(frames):
    patient = SceneSession(frames)
    reported = patient.measure(700)
    assert {len(one.breaths) for one in reported if one.state is MeasurementState.TRAINING} == {0}
    assert all(tuple(b.signal for b in one.breaths) == CHOICES for one in reported if one.motion is not None)
    last = reported[-1].breaths
    assert all(breath.phase_percent is not None and not breath.events for breath in last)
    assert [breath.rate_per_min for breath in last] == pytest.approx([15.0] * 3, rel=0.03)
    assert last[1].amplitude < 2.0 < last[0].amplitude < last[2].amplitude


@pytest.mark.parametrize("more", [1, 45, 90], ids=["low", "rising", "falling"])
def test_a_reference_that_a_person_sets_is_neither_drift_nor_cough_and_keeps_the_phase(patient, more):
    before = patient.measure(more)[-1]
    patient.pipeline.learner.set_reference()
    after = patient.measure(300)
    assert abs(after[0].motion.whole_mm) < 0.5
    assert all(breath.phase_percent is not None for one in after for breath in one.breaths)
    assert {kind for one in after for breath in one.breaths for kind in kinds(breath)} == set()
    assert after[-1].breaths[0].drift == pytest.approx(0.0, abs=0.4)
    moved = after[0].breaths[0].baseline - before.breaths[0].baseline
    assert moved == pytest.approx(after[0].motion.whole_mm - before.motion.whole_mm, abs=1.0)


def test_a_model_that_takes_over_is_neither_drift_nor_cough(patient):
    generation = patient.pipeline.learner.status.model_generation
    patient.pipeline.learner.retrain()
    after = patient.measure(400)
    assert patient.pipeline.learner.status.model_generation > generation
    assert {kind for one in after for breath in one.breaths for kind in kinds(breath)} == set()
    assert after[-1].breaths[0].drift == pytest.approx(0.0, abs=0.4)
    assert after[-1].breaths[0].phase_percent is not None


def test_a_lost_frame_has_no_breath_and_a_second_of_them_costs_the_phase(patient):
    dark = {"color": 0 * patient.frames[0].color}
    lost = [patient.next(**dark) for _ in range(30)]
    assert all(one.state is MeasurementState.LOST and one.breaths == () for one in lost)
    back = patient.measure(3)
    assert all(one.breaths[0].phase_percent is None for one in back)
    assert patient.measure(500)[-1].breaths[0].phase_percent is not None


def nearer(frames, by_mm):
    """The same frames from a camera that hangs so much nearer."""
    return [replace(one, depth_mm=one.depth_mm - np.uint16(by_mm) * (one.depth_mm > 0)) for one in frames]


def test_a_camera_that_comes_back_nearer_is_no_drift_of_the_patient(patient):
    patient.pipeline.camera_returned()
    patient.frames = nearer(patient.frames, 10)
    patient.measure(130)
    patient.pipeline.learner.set_reference()
    after = patient.measure(700)
    assert after[-1].breaths[0].phase_percent is not None
    assert abs(after[-1].breaths[0].drift) < 0.5
    assert {kind for one in after for breath in one.breaths for kind in kinds(breath)} == set()


def test_drift_is_relative_to_the_reference_even_where_no_end_of_exhale_was_known_then(patient):
    dark = {"color": 0 * patient.frames[0].color}
    for _ in range(30):
        patient.next(**dark)
    patient.frames = nearer(patient.frames, 3)
    assert patient.next().breaths[0].baseline is None
    patient.pipeline.learner.set_reference()
    after = patient.measure(700)
    assert abs(after[-1].breaths[0].drift) < 0.5


def test_a_confirmed_correction_moves_the_baseline_of_drift(patient):
    before = patient.next().breaths
    patient.pipeline.correct_baseline(SignalChoice(), 1.5)
    after = patient.next().breaths
    assert after[0].drift == pytest.approx(before[0].drift - 1.5, abs=0.01)
    assert after[2].drift == pytest.approx(before[2].drift, abs=0.01)


def test_more_than_four_signals_or_one_twice_are_refused():
    points = tuple((10 * n + 10, 20) for n in range(5))
    five = tuple(SignalChoice(signal="point", row=row, column=20, index=i) for i, (row, _) in enumerate(points))
    with pytest.raises(InvalidValueError, match="breath_signals is 5: must be at most 4 signals"):
        PipelineSettings(breath_signals=five)
    with pytest.raises(InvalidValueError, match=r"breath_signals is .*: must be each signal once"):
        PipelineSettings(breath_signals=(SignalChoice(), SignalChoice()))


def followed(tracker, levels_mm):
    """Breathe at 15 a minute, 10 mm deep, with these ends of exhale; return the breath after each."""
    found = []
    for number, level in enumerate(levels_mm):
        following = levels_mm[min(number + 1, len(levels_mm) - 1)]
        for step in range(120):
            rest = level if step < 60 else following
            value = rest + (10.0 + max(level, following) - rest) * 0.5 * (1.0 - np.cos(np.pi * step / 60.0))
            index = 120 * number + step + followed.since
            found.append(tracker.follow(motion_of(value), round(index * 1e6 / 30.0))[0])
    followed.since += 120 * len(levels_mm)
    return found


@pytest.mark.parametrize("hitch_mm", [-3.0, 0.0, 3.0])
def test_drift_counts_from_a_reference_at_the_ends_of_exhale_whatever_the_last_breath_was(hitch_mm):
    """A hitch before the reference moved the level that drift counts from, and hid a drift of its size."""
    followed.since = 0
    tracker = BreathTracker((SignalChoice(),))
    followed(tracker, [0.0] * 6 + [hitch_mm])
    tracker.move(motion_of(hitch_mm), motion_of(hitch_mm), is_end_exhale=True)
    assert followed(tracker, [0.0] * 5)[-1].exhale_drift == pytest.approx(0.0, abs=0.3)
    assert followed(tracker, [2.0] * 5)[-1].exhale_drift == pytest.approx(2.0, abs=0.3)


def test_drift_counts_from_the_last_end_of_exhale_where_the_reference_is_another_moment():
    followed.since = 0
    tracker = BreathTracker((SignalChoice(),))
    followed(tracker, [0.0] * 6)
    tracker.move(motion_of(5.0), motion_of(0.0), is_end_exhale=False)
    assert followed(tracker, [-5.0] * 5)[-1].exhale_drift == pytest.approx(0.0, abs=0.3)
