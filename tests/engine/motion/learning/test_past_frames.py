"""The frames of the training propose a reference as soon as there is a model; none from before a gap or a movement."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import SignalChoice
from engine.core.errors import CommandRefusedError
from engine.core.reference import ReferenceMoment
from engine.motion.learning.past_frames import PastBreaths, PastFrames
from engine.motion.learning.tasks import Candidate, PastBreathsJob
from engine.motion.learning.trainer import TrainingSettings
from tests.support.motion import training_frames
from tests.support.motion.held_trainer import HeldTrainer
from tests.support.motion.scene_session import SETTINGS, SceneSession, scene_frames
from tests.support.motion.training_frames import FEW, FRAME_US, STAGES, Patient

pytestmark = pytest.mark.verification

EXHALE, INHALE, NOW = ReferenceMoment
BREATH = 120
"""Frames of a breath."""
TRAINING = TrainingSettings(min_frames=40, min_seconds=9.5, min_cycles=1, max_seconds=20.0, refit_until_s=0.0)
LONG = replace(SETTINGS, training=TRAINING)


@pytest.fixture(scope="module")
def frames():
    return scene_frames()


def proposed(session):
    return {one.moment: one for one in session.pipeline.learner.status.reference_proposals}


def dark(session, count):
    for _ in range(count):
        session.next(color=0 * session.frames[0].color)


def learned(frames, *, choice=SignalChoice()):  # noqa: B008 - a frozen value
    session = SceneSession(frames, replace(LONG, breath_signals=(choice,)))
    while session.next().motion is None:
        assert proposed(session) == {}
    return session


@pytest.mark.parametrize("choice", [SignalChoice(), SignalChoice(signal="volume")], ids=lambda choice: choice.label)
def test_the_first_measured_frame_comes_with_a_proposal_of_the_training(frames, choice):
    session = learned(frames, choice=choice)
    assert proposed(session)[EXHALE].breaths == 2
    assert proposed(session)[EXHALE].percent == pytest.approx(0.0, abs=5.0)
    breath = session.measure(BREATH)
    levels = np.array([one.motion.whole_mm if choice.signal == "whole" else one.motion.volume_l for one in breath])
    assert proposed(session)[EXHALE].level == pytest.approx(levels.min(), abs=0.05 * np.ptp(levels))


def test_a_reference_of_the_training_is_at_the_end_of_exhale(frames):
    session = learned(frames)
    session.pipeline.learner.set_reference(EXHALE)
    levels_mm = np.array([one.motion.whole_mm for one in session.measure(BREATH)])
    assert levels_mm.min() == pytest.approx(0.0, abs=0.05 * np.ptp(levels_mm))
    assert session.pipeline.learner.status.has_reference
    assert proposed(session)[EXHALE].level == pytest.approx(0.0, abs=0.05 * np.ptp(levels_mm))


def test_breaths_of_the_training_and_later_ones_are_one_row(frames):
    session = learned(frames)
    known = [proposed(session)[EXHALE].breaths]
    for _ in range(2 * BREATH):
        session.next()
        known.append(proposed(session)[EXHALE].breaths)
    assert sorted(set(known)) == [2, 3, 4]
    assert known == sorted(known)
    assert proposed(session)[EXHALE].scatter < 0.2


# -- gaps, between any two of them and the present ---------------------------------------------------------------


def test_no_breath_from_before_a_gap_in_the_training_is_proposed(frames):
    session = SceneSession(frames, LONG)
    session.measure(2 * BREATH + 30)
    dark(session, 40)
    while session.next().motion is None:
        pass
    assert proposed(session) == {}
    with pytest.raises(CommandRefusedError, match="fewer than two breaths"):
        session.pipeline.learner.set_reference(EXHALE)


@pytest.fixture
def fitting(frames):
    """A session whose first fit takes as long as the test lets it."""
    session = SceneSession(frames, LONG, HeldTrainer())
    while not session.trainer.is_busy:
        session.next()
    return session


def test_the_frames_of_a_long_fit_belong_to_the_breaths_and_follow_a_few_with_each_live_frame(fitting):
    fitting.measure(3 * BREATH)
    fitting.trainer.finish()
    fitting.measure(1)
    assert proposed(fitting) == {}
    fitting.measure(BREATH // 2)  # following them takes longer than a gap may be
    assert proposed(fitting)[EXHALE].breaths == 5
    levels_mm = np.array([one.motion.whole_mm for one in fitting.measure(BREATH)])
    assert proposed(fitting)[EXHALE].level == pytest.approx(levels_mm.min(), abs=0.05 * np.ptp(levels_mm))


def test_the_breaths_do_not_depend_on_when_the_fit_was_done(fitting, frames):
    """A tape knows at which frame the model arrived, and fits it at once when it is replayed."""
    fitting.measure(40)
    fitting.trainer.finish()
    fitting.measure(40)
    replayed = SceneSession(frames, LONG, HeldTrainer())
    while not replayed.trainer.is_busy:
        replayed.next()
    job, results = replayed.trainer.job, []
    replayed.trainer.job = lambda: results[0]
    results.append(job())
    replayed.measure(40)
    replayed.trainer.finish()
    replayed.measure(40)
    assert proposed(replayed) == proposed(fitting)
    assert proposed(fitting).keys() == {EXHALE}


def test_no_breath_from_before_a_gap_during_the_fit_is_proposed(fitting):
    dark(fitting, 40)
    fitting.measure(3)
    fitting.trainer.finish()
    fitting.measure(20)
    assert proposed(fitting) == {}


def test_no_breath_from_before_a_gap_behind_the_fit_is_proposed(fitting):
    fitting.trainer.finish()
    dark(fitting, 1)
    assert fitting.pipeline.learner.active is not None
    dark(fitting, 40)
    with pytest.raises(CommandRefusedError, match="fewer than two breaths"):
        fitting.pipeline.learner.set_reference(EXHALE)
    fitting.measure(1)
    assert proposed(fitting) == {}


def test_no_breath_from_before_the_camera_was_away_is_proposed(fitting):
    fitting.pipeline.camera_returned()
    fitting.trainer.finish()
    fitting.next()
    while not fitting.trainer.is_busy:
        fitting.next()
    fitting.trainer.finish()
    fitting.next()
    assert proposed(fitting)[EXHALE].breaths == 2


def test_breaths_that_are_still_being_followed_are_dropped_when_the_camera_was_away(fitting):
    fitting.measure(BREATH)
    fitting.trainer.finish()
    fitting.measure(1)
    fitting.pipeline.camera_returned()
    fitting.measure(BREATH // 4)
    assert proposed(fitting) == {}


# -- the frames alone -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def active():
    patient = Patient(FEW)
    patient.learn()
    return patient.learner.active


def proposals_of(active, frames):
    """Positions of frames, as the job of a first fit finds them behind the fit."""
    past = PastFrames(training_frames.vertices)
    for one in frames:
        if past.is_due(one.timestamp_us):
            past.add(one)
    return PastBreathsJob(
        job=lambda: Candidate(active=active), stretch=past.stretch, stages=STAGES
    )().past_breaths.proposals


def breaths(count, **surface):
    return [
        training_frames.frame(index, **{name: part(index) for name, part in surface.items()})
        for index in range(round(count * BREATH))
    ]


def known(proposals, now):
    found = proposals.proposals({}, now * FRAME_US)
    return {one.moment: one.breaths for one in found}


def test_two_whole_breaths_are_needed(active):
    assert known(proposals_of(active, breaths(2.3)), round(2.3 * BREATH)) == {EXHALE: 2}
    assert known(proposals_of(active, breaths(1.3)), round(1.3 * BREATH)) == {}


def test_breaths_before_a_movement_across_the_couch_are_dropped(active):
    moved = breaths(2.5, shift_mm=lambda index: (6.0 if index > 2.2 * BREATH else 0.0, 0.0, 0.0))
    assert known(proposals_of(active, moved), round(2.5 * BREATH)) == {}


def test_breaths_before_a_movement_towards_the_camera_are_not_averaged_with_those_after_it(active):
    moved = breaths(3.5, shift_mm=lambda index: (0.0, 0.0, -4.0 if index > 2.5 * BREATH else 0.0))
    assert known(proposals_of(active, moved), round(3.5 * BREATH)) == {}


def test_frames_of_the_fit_follow_a_few_at_a_time(active):
    past, follower = PastFrames(training_frames.vertices), PastBreaths(active, STAGES.measure_past(active))
    for one in breaths(2)[::3]:
        past.add(one)
    assert follower.follow(past.stretch)
    for one in breaths(2.3)[2 * BREATH :: 3]:
        past.add(one)
    assert [follower.follow(past.stretch, 5) for _ in range(4)] == [False, False, True, True]
    assert known(follower.proposals, round(2.3 * BREATH)) == {EXHALE: 2}


def test_breaths_before_a_movement_during_the_fit_are_dropped(active):
    past, follower = PastFrames(training_frames.vertices), PastBreaths(active, STAGES.measure_past(active))
    for one in breaths(2.5, shift_mm=lambda index: (6.0 if index > 2.4 * BREATH else 0.0, 0.0, 0.0))[::3]:
        past.add(one)
        follower.follow(past.stretch)
    assert known(follower.proposals, round(2.5 * BREATH)) == {}


def test_frames_are_kept_for_as_long_as_a_breath_may_be_proposed():
    past = PastFrames(training_frames.vertices)
    for one in breaths(14):
        if past.is_due(one.timestamp_us):
            past.add(one)
    kept_us = past.stretch.frames[-1].timestamp_us - past.stretch.frames[0].timestamp_us
    assert kept_us == pytest.approx(45e6, abs=0.2e6)
    assert len(past.stretch.frames) <= 451


@pytest.mark.parametrize(("last", "next_one", "kept"), [(90, 20, 1), (90, 90 + 31, 1), (90, 90 + 29, 31 + 1)])
def test_a_second_without_a_frame_and_a_step_back_of_the_devices_clock_are_gaps(last, next_one, kept):
    past = PastFrames(training_frames.vertices)
    for index in (*range(0, last + 1, 3), next_one):
        past.add(training_frames.frame(index))
    assert len(past.stretch.frames) == kept


def test_only_a_first_fit_looks_for_breaths():
    patient = Patient(FEW)
    patient.learn()
    assert patient.learner.reference.levels_from is not None
    patient.learner.reference.move_levels(*_still(patient))
    patient.learner.retrain(keeps_reference=False)
    generation = patient.learner.journal.generation
    patient.see_until(lambda: patient.learner.journal.generation != generation)
    assert patient.learner.reference.levels_from is None


def _still(patient):
    measured = STAGES.measure_past(patient.learner.active)(training_frames.frame(patient.index))
    return measured.motion, measured.motion
