"""A stored model keeps the sensor's depth steps, and is refused where the session's differ."""

from dataclasses import replace

import numpy as np
import pytest

from engine.calibration.quantisation import DepthSteps
from engine.core.errors import InvalidValueError, ModelError, ModelMismatchError
from engine.core.learning_status import LearningEventKind
from engine.motion.learning.depth_steps import MAX_DIFFERENCE_MM, steps_mismatch, stored_steps
from engine.motion.learning.model_file import load_model, save_model
from tests.support.motion.training_frames import Patient
from tests.support.service.fake_engine import make_model

STEPS = DepthSteps(offset_per_mm=-7e-7, step_per_mm=2.9215e-6, rounding_mm=0.5, agreement=1.0)
OURS = stored_steps(STEPS)
AGAIN = stored_steps(replace(STEPS, offset_per_mm=-7.4e-7, step_per_mm=2.92163e-6))
"""The same sensor's steps as another session finds them."""
OTHER = stored_steps(replace(STEPS, offset_per_mm=-7e-7 + 1.46e-6))
"""Half a step beside them."""


def model(steps):
    return replace(make_model(), depth_steps=steps)


@pytest.fixture(scope="module")
def learned():
    """A model that was learned with these steps."""
    patient = Patient()
    patient.learner.models.depth_steps = OURS
    return patient.learn()


def test_a_model_is_stored_with_the_steps_of_its_training(learned):
    assert learned.depth_steps == OURS


@pytest.mark.parametrize(("stored", "session"), [(OURS, OURS), (OURS, AGAIN), ((), ()), (None, OURS), (OURS, None)])
def test_the_same_steps_and_unknown_ones_are_no_mismatch(stored, session):
    assert steps_mismatch(model(stored), session) is None


@pytest.mark.parametrize(
    ("stored", "session"),
    [(OURS, OTHER), (OURS, ()), ((), OURS), (OURS, stored_steps(replace(STEPS, rounding_mm=0.0, offset_per_mm=2e-7)))],
)
def test_other_steps_are_refused_with_the_difference(stored, session):
    found = steps_mismatch(model(stored), session)
    assert found is not None
    assert found.field == "model.depth_steps"
    assert float(found.value.removesuffix(" mm")) > MAX_DIFFERENCE_MM


def test_a_stored_model_of_other_steps_is_dropped_after_the_comparison_and_a_new_one_is_learned(learned):
    patient = Patient()
    patient.learner.models.depth_steps = OTHER
    patient.learner.models.resume(learned)
    patient.see_until(lambda: patient.learner.status.patient_match is not None)
    match = patient.learner.status.patient_match
    assert match.refusal.field == "model.depth_steps"
    assert patient.learner.status.model is None
    assert patient.learner.models.is_gathering
    assert "another reading of the sensor's depths" in patient.reported(LearningEventKind.REFUSED)[-1].detail


def test_a_stored_model_of_the_same_steps_is_used(learned):
    patient = Patient()
    patient.learner.models.depth_steps = AGAIN
    patient.learner.models.resume(learned)
    patient.see_until(lambda: patient.learner.status.patient_match is not None)
    assert patient.learner.status.patient_match.refusal is None
    assert patient.learner.status.model is not None


def test_a_model_of_other_steps_is_not_activated(learned):
    patient = Patient()
    patient.learner.models.depth_steps = OTHER
    with pytest.raises(ModelMismatchError, match="depth_steps"):
        patient.learner.activate(learned)


@pytest.mark.parametrize("steps", [None, (), OURS])
def test_the_steps_survive_the_file(tmp_path, steps):
    save_model(model(steps), tmp_path / "model.npz")
    assert load_model(tmp_path / "model.npz").depth_steps == steps


@pytest.mark.parametrize("steps", [(1.0,), (0.0, 1.0, 0.5, 1.0)])
def test_a_model_has_three_numbers_or_none(steps):
    with pytest.raises(ModelError, match="depth steps"):
        model(steps)


@pytest.mark.parametrize("steps", [(1.0, 3e-6, 0.5), (0.0, 0.0, 0.5), (0.0, 3e-6, 2.0), (np.nan, 3e-6, 0.5)])
def test_steps_beyond_their_bounds_are_no_model(tmp_path, steps):
    def stored():
        save_model(model(steps), tmp_path / "model.npz")
        return load_model(tmp_path / "model.npz")

    with pytest.raises((ModelError, InvalidValueError, ValueError)):
        stored()
