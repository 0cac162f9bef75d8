"""A model that was learned in the session is refitted to the stretch so far; it takes over without a step."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import CommandRefusedError
from engine.core.learning_status import LearningEventKind
from engine.motion.learning.refit import GROWTH
from engine.motion.stages.roi import at_nodes
from tests.support.motion import training_frames
from tests.support.motion.held_trainer import HeldTrainer
from tests.support.motion.training_frames import BELLY, CHEST, FEW, FRAME_US, STAGES, Patient, breath

pytestmark = [pytest.mark.long, pytest.mark.verification]

UNTIL_S = 30.0
REFITTING = replace(FEW, refit_until_s=UNTIL_S)
STEADY = (1.0, 2.5)


def seconds_of(patient, kind):
    return [notice.timestamp_us / 1e6 for notice in patient.reported(kind)]


def see_for(patient, seconds, **surface):
    until = patient.index + round(seconds * 1e6 / FRAME_US)
    return patient.see_until(lambda: patient.index >= until, **surface)


def learned(settings=REFITTING, **options):
    patient = Patient(settings, **options)
    patient.learn()
    return patient


def test_a_model_is_refitted_each_time_the_stretch_has_doubled_and_no_more_frames_are_kept_after_the_last():
    patient = learned()
    see_for(patient, 30.0)
    first_s, *refits_s = seconds_of(patient, LearningEventKind.SWAPPED)
    assert refits_s == pytest.approx([GROWTH * first_s, GROWTH**2 * first_s], rel=0.1)
    assert patient.learner.active.model.seconds == pytest.approx(refits_s[-1], abs=0.2)
    assert refits_s[-1] * GROWTH > UNTIL_S
    assert not patient.learner.needs(patient.index * FRAME_US).is_fine
    assert not patient.learner.refits._refits._stretch.longest.frames


def test_without_refits_no_frame_is_kept():
    patient = learned(FEW)
    see_for(patient, 30.0)
    assert len(patient.reported(LearningEventKind.SWAPPED)) == 1
    assert not patient.learner.needs(patient.index * FRAME_US).is_fine


def test_a_refit_steps_no_region_of_a_steady_surface():
    steady = [training_frames.frame(9000 + i, excursion=STEADY) for i in range(30)]
    patient = learned()
    first = patient.learner.active
    before = np.mean([patient.measured(frame) for frame in steady], axis=0)
    see_for(patient, GROWTH * first.model.seconds)
    assert patient.learner.active is not first
    assert patient.learner.status.reference_number == 1
    step = np.abs(np.mean([patient.measured(frame) for frame in steady], axis=0) - before)
    assert step[patient.whole : patient.whole + 3].max() < 0.05
    assert step[: patient.whole].max() < 0.15


def test_a_refit_knows_what_the_first_breaths_did_not_show():
    """The chest begins to breathe before the belly only after the first model: its cells' error halves."""

    def later(index):
        chest, _ = breath(index * FRAME_US / 1e6, period_s=3.0)
        _, belly = breath(index * FRAME_US / 1e6)
        return 2.0 * chest, belly

    def error_mm(patient):
        active = patient.learner.active
        depths_mm = []
        for excursion in ((0.0, 0.0), (4.0, 2.0)):
            frames = [training_frames.frame(9000 + i, excursion=excursion) for i in range(20)]
            outcomes = [training_frames.explain(active, frame.roi, None) for frame in frames]
            depths_mm.append(np.mean([active.node_depth_mm(outcome.coefficients) for outcome in outcomes], axis=0))
        moved_mm = at_nodes(4.0 * CHEST + 2.0 * BELLY, training_frames.STRIDE_PX)
        return np.abs(depths_mm[0] - depths_mm[1] - moved_mm).mean()

    first, refitted = learned(), learned()
    see_for(refitted, 23.0, excursion=later)
    assert error_mm(refitted) < 0.5 * error_mm(first)


def test_no_refit_is_begun_while_the_gate_is_armed_but_after():
    patient = learned()
    patient.learner.keep_model(is_kept=True)
    see_for(patient, 15.0)
    assert not patient.reported(LearningEventKind.STARTED)
    patient.learner.keep_model(is_kept=False)
    see_for(patient, 0.2)
    assert len(patient.reported(LearningEventKind.SWAPPED)) == 2
    assert patient.learner.active.model.seconds > 15.0


def test_a_gate_that_stays_armed_costs_no_more_frames_than_the_longest_refit():
    patient = learned()
    patient.learner.keep_model(is_kept=True)
    see_for(patient, 1.25 * UNTIL_S)
    assert not patient.learner.needs(patient.index * FRAME_US).is_fine
    assert not patient.learner.refits._refits._stretch.longest.frames
    patient.learner.keep_model(is_kept=False)
    see_for(patient, 1.0)
    assert not patient.reported(LearningEventKind.STARTED)


def test_a_model_fitted_before_the_gate_was_armed_waits_until_it_is_not():
    patient = Patient(REFITTING, trainer=HeldTrainer())
    trainer = patient.learner.models._trainer
    patient.see_until(lambda: trainer.job is not None)
    trainer.finish()
    patient.see()
    first = patient.learner.active
    patient.see_until(lambda: trainer.job is not None)
    patient.learner.keep_model(is_kept=True)
    trainer.finish()
    see_for(patient, 1.0)
    assert patient.learner.active is first
    assert patient.learner.status.is_model_waiting
    patient.learner.keep_model(is_kept=False)
    patient.see()
    assert patient.learner.active is not first


def test_a_requested_retraining_drops_a_refit_in_progress():
    """The model of the refit is not used, and the requested one is learned after its end."""
    patient = learned()
    patient.learner.models._trainer = trainer = HeldTrainer()
    first = patient.learner.active
    patient.see_until(lambda: trainer.job is not None)
    patient.learner.retrain()
    see_for(patient, 1.0)
    trainer.finish()
    patient.see()
    assert patient.learner.active is first
    assert not patient.reported(LearningEventKind.READY)
    patient.see_until(lambda: trainer.job is not None)
    with pytest.raises(CommandRefusedError, match="already"):
        patient.learner.retrain()
    trainer.finish()
    patient.see()
    assert patient.learner.active is not first
    assert len(patient.reported(LearningEventKind.READY)) == 1


def test_a_dropped_refit_does_not_let_a_retraining_skip_the_comparison_with_the_patient():
    patient = learned()
    patient.learner.models._trainer = trainer = HeldTrainer()
    patient.see_until(lambda: trainer.job is not None)
    patient.learner.restart_after_disconnection()
    with pytest.raises(CommandRefusedError, match="compared"):
        patient.learner.retrain()


def test_after_a_movement_the_stretch_begins_anew():
    patient = learned()
    moved = {"shift_mm": (12.0, 0.0, 0.0)}
    see_for(patient, 1.0, **moved)
    moved_s = patient.index * FRAME_US / 1e6
    patient.see_until(lambda: len(patient.reported(LearningEventKind.SWAPPED)) == 2, **moved)
    first_s, refitted_s = seconds_of(patient, LearningEventKind.SWAPPED)
    assert refitted_s - moved_s + 1.0 == pytest.approx(GROWTH * first_s, rel=0.1)


def test_a_stored_model_is_used_as_it_is():
    patient = learned()
    model = patient.learner.active.model
    patient.learner.activate(model)
    see_for(patient, 30.0)
    assert patient.learner.active.model is model
    resumed = Patient(REFITTING)
    resumed.learner.models.resume(model)
    see_for(resumed, 30.0)
    assert resumed.learner.active.model is model
    assert not resumed.learner.needs(resumed.index * FRAME_US).is_fine


def test_a_refused_refit_leaves_the_model_and_the_next_waits_for_twice_the_stretch():
    patient = learned()
    first = patient.learner.active

    def elsewhere(model):
        active = STAGES.prepare(model)
        return replace(active, regions=replace(active.regions, mean_mm=active.regions.mean_mm + 1.5))

    patient.learner.refits._refits._stages = replace(STAGES, prepare=elsewhere)
    see_for(patient, 9.0)
    (refused_s,) = seconds_of(patient, LearningEventKind.REFUSED)
    assert refused_s == pytest.approx(GROWTH * first.model.seconds, rel=0.1)
    assert patient.learner.active is first
    see_for(patient, 15.0)
    assert seconds_of(patient, LearningEventKind.REFUSED)[1] == pytest.approx(GROWTH * refused_s, rel=0.1)


def test_a_person_s_training_begins_another_stretch():
    patient = learned()
    see_for(patient, 3.0)
    patient.learner.retrain()
    began_s = patient.index * FRAME_US / 1e6
    patient.see_until(lambda: len(patient.reported(LearningEventKind.SWAPPED)) == 3)
    _, trained_s, refitted_s = seconds_of(patient, LearningEventKind.SWAPPED)
    assert refitted_s - began_s == pytest.approx(GROWTH * (trained_s - began_s), rel=0.1)


def test_only_a_new_reference_is_a_new_position():
    """What follows the patient from frame to frame must not accept another surface because a model was refitted."""
    patient = learned()
    position, generation = patient.learner.journal.position_generation, patient.learner.journal.generation
    see_for(patient, 10.0)
    assert patient.learner.journal.generation == generation + 1
    assert patient.learner.journal.position_generation == position
    patient.learner.set_reference()
    assert patient.learner.journal.position_generation == position + 1
