"""The camera was away: the model is doubted as a stored one is, and a person sets the zero."""

from dataclasses import replace

import pytest

from engine.core.errors import CommandRefusedError
from engine.core.learning_status import LearningEventKind
from tests.support.motion.held_trainer import HeldTrainer
from tests.support.motion.training_frames import Patient

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def learned():
    return Patient().learn()


@pytest.fixture
def patient(learned):
    """A patient who is measured and has a zero."""
    patient = Patient()
    patient.learner.activate(learned)
    patient.learner.set_reference()
    patient.see(excursion=(0.0, 0.0))
    assert patient.learner.status.has_reference
    return patient


def test_the_model_measures_on_but_arming_is_refused_until_it_was_compared_and_a_person_has_set_the_reference(patient):
    active, generation = patient.learner.active, patient.learner.journal.generation
    patient.learner.restart_after_disconnection()
    assert patient.learner.journal.generation > generation, "what was armed is armed no more"
    assert patient.see() is not None
    assert patient.learner.active is active
    assert "compared" in patient.learner.status.model_shortcoming
    assert not patient.learner.status.has_reference
    patient.see_until(lambda: patient.learner.status.patient_match is not None)
    assert patient.learner.status.model_shortcoming is None
    assert patient.learner.active is active
    assert not patient.learner.status.has_reference, "motion is shown against the first frame, and arming is refused"
    patient.learner.set_reference()
    patient.see()
    assert patient.learner.status.has_reference
    assert patient.reported(LearningEventKind.ZERO_NEEDED)


def test_what_an_earlier_comparison_stated_is_stated_no_more(patient):
    patient.learner.restart_after_disconnection()
    patient.see_until(lambda: patient.learner.status.patient_match is not None)
    patient.learner.restart_after_disconnection()
    assert patient.learner.status.patient_match is None


def test_a_reference_that_was_just_wanted_is_not_set_by_the_camera_s_return(patient):
    patient.learner.set_reference()
    patient.learner.restart_after_disconnection()
    patient.see()
    assert not patient.learner.status.has_reference


def test_a_camera_that_hangs_far_from_where_it_did_costs_the_model(patient):
    patient.learner.restart_after_disconnection()
    patient.see_until(lambda: patient.learner.active is None, shift_mm=(60.0, 0.0, 0.0))
    assert patient.learner.models.is_gathering
    assert patient.reported(LearningEventKind.REFUSED)


def test_what_was_being_gathered_or_waited_is_dropped(patient):
    active = patient.learner.active
    patient.learner.keep_model(is_kept=True)
    patient.learner.retrain()
    patient.see_until(lambda: patient.learner.status.is_model_waiting)
    patient.learner.restart_after_disconnection()
    patient.learner.keep_model(is_kept=False)
    assert not patient.learner.status.is_model_waiting
    patient.see_until(lambda: patient.learner.status.patient_match is not None)
    assert patient.learner.active is active


def test_a_model_that_was_being_fitted_from_frames_of_before_never_takes_over(learned):
    trainer = HeldTrainer()
    patient = Patient(trainer=trainer)
    patient.learner.activate(learned)
    trainer.finish()
    patient.see(excursion=(0.0, 0.0))
    active = patient.learner.active
    patient.learner.retrain()
    patient.see_until(lambda: trainer.is_busy)
    patient.learner.restart_after_disconnection()
    trainer.finish()
    for _ in range(5):
        patient.see()
    assert patient.learner.active is active
    assert not patient.learner.status.has_reference
    patient.see_until(lambda: trainer.is_busy)
    trainer.finish()
    patient.see()
    assert patient.learner.status.patient_match is not None


def test_before_there_is_a_model_the_gathering_begins_anew():
    patient = Patient()
    for _ in range(40):
        patient.see()
    before = patient.learner.models.progress.frames
    patient.learner.restart_after_disconnection()
    assert before > 0
    assert patient.learner.models.progress.frames == 0
    patient.see_until(lambda: patient.learner.active is not None)


def test_a_first_model_fitted_from_frames_of_before_is_learned_again(learned):
    trainer = HeldTrainer()
    patient = Patient(trainer=trainer)
    patient.see_until(lambda: trainer.is_busy)
    patient.learner.restart_after_disconnection()
    trainer.finish()
    patient.see()
    assert patient.learner.active is None
    assert patient.learner.models.is_gathering


def test_a_model_that_cannot_be_compared_is_learned_again(patient):
    active = patient.learner.active
    patient.learner.models.active = replace(active, model=replace(active.model, surface_mm=None))
    patient.learner.restart_after_disconnection()
    assert patient.learner.active is None
    assert patient.learner.models.is_gathering


def test_no_training_while_the_patient_is_compared(patient):
    patient.learner.restart_after_disconnection()
    with pytest.raises(CommandRefusedError, match="compared"):
        patient.learner.retrain()


DROPPED = "dropped: the camera was disconnected"


def dropped(patient):
    patient.see()
    return [one for one in patient.reported(LearningEventKind.REFUSED) if DROPPED in one.detail]


def test_dropping_a_model_that_was_just_activated_is_reported(patient, learned):
    patient.learner.activate(replace(learned, cycles=learned.cycles + 1))
    patient.see()
    patient.learner.restart_after_disconnection()
    assert len(dropped(patient)) == 1


def test_dropping_a_waiting_model_is_reported(patient):
    patient.learner.keep_model(is_kept=True)
    patient.learner.retrain()
    patient.see_until(lambda: patient.learner.status.is_model_waiting)
    patient.learner.restart_after_disconnection()
    assert len(dropped(patient)) == 1


def test_dropping_a_running_training_is_reported(patient):
    patient.learner.retrain()
    patient.see()
    patient.learner.restart_after_disconnection()
    assert len(dropped(patient)) == 1


def test_dropping_a_running_fit_is_reported_once(learned):
    trainer = HeldTrainer()
    patient = Patient(trainer=trainer)
    patient.see_until(lambda: trainer.is_busy)
    patient.learner.restart_after_disconnection()
    patient.learner.restart_after_disconnection()
    assert len(dropped(patient)) == 1


def test_where_nothing_was_dropped_nothing_is_reported(patient):
    patient.learner.restart_after_disconnection()
    patient.see()
    patient.learner.restart_after_disconnection()
    assert not dropped(patient)
