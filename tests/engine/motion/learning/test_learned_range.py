"""The range a patient breathed over in the training, against today's zero."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import WHOLE, SignalChoice
from engine.core.errors import ModelError
from engine.motion.learning.model_file import load_model, save_model
from engine.motion.learning.reference_history import learned_ranges
from tests.support.motion.training_frames import Patient

CHOICES = [
    WHOLE,
    SignalChoice(signal="thorax"),
    SignalChoice(signal="abdomen"),
    SignalChoice(signal="region", row=10, column=4),
    SignalChoice(signal="volume"),
]


@pytest.fixture(scope="module")
def learned():
    patient = Patient()
    patient.learn()
    measured = [patient.see() for _ in range(260)]
    lifts = np.array([one for one in measured if one is not None])
    return patient.learner.active, patient.learner.reference.current, lifts


@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: choice.label)
def test_the_range_is_what_the_patient_goes_on_to_breathe_over(learned, choice):
    active, reference, measured = learned
    found = learned_ranges(active, reference, [choice])[choice]
    place = {"whole": 112, "thorax": 113, "abdomen": 114, "region": 10 * 8 + 4, "volume": -1}[choice.signal]
    low, high = np.percentile(measured[:, place], [5.0, 95.0])
    span = high - low
    assert found.low == pytest.approx(low, abs=0.08 * span)
    assert found.high == pytest.approx(high, abs=0.08 * span)


def test_a_reference_elsewhere_moves_the_range_and_does_not_stretch_it(learned):
    active, reference, _ = learned
    before = learned_ranges(active, reference, [WHOLE])[WHOLE]
    moved = replace(reference, regions_mm=reference.regions_mm + 3.0)
    after = learned_ranges(active, moved, [WHOLE])[WHOLE]
    assert (after.low - before.low, after.high - before.high) == (pytest.approx(3.0), pytest.approx(3.0))


@pytest.mark.parametrize(
    "choice",
    [
        SignalChoice(signal="point", row=1, column=1, index=0),
        SignalChoice(signal="named", name="belly", index=0),
        SignalChoice(signal="region", row=99, column=0),
    ],
    ids=lambda choice: choice.label,
)
def test_what_is_not_measured_has_no_range(learned, choice):
    active, reference, _ = learned
    assert learned_ranges(active, reference, [choice]) == {}


def test_a_model_that_noted_no_scores_has_no_range(learned):
    active, reference, _ = learned
    old = replace(active, model=replace(active.model, scores_mm=None))
    assert learned_ranges(old, reference, CHOICES) == {}


def test_holes_in_the_surface_do_not_cost_the_volume_its_range(learned):
    active, reference, _ = learned
    volume = CHOICES[-1]
    surface = active.model.surface_mm.copy()
    surface[::9] = np.nan
    holed = replace(active, model=replace(active.model, surface_mm=surface))
    whole, found = (learned_ranges(one, reference, [volume])[volume] for one in (active, holed))
    assert found.high - found.low == pytest.approx(whole.high - whole.low, rel=0.01)
    surface = surface.copy()
    surface[: len(surface) * 2 // 3] = np.nan
    blind = replace(active, model=replace(active.model, surface_mm=surface))
    assert learned_ranges(blind, reference, [volume]) == {}


def test_a_model_s_file_keeps_the_scores(learned, tmp_path):
    active, _, _ = learned
    save_model(active.model, tmp_path / "model.npz")
    assert np.array_equal(load_model(tmp_path / "model.npz").scores_mm, active.model.scores_mm)


@pytest.mark.parametrize(
    "scores", [np.zeros((5, 7)), np.zeros(3), np.full((4, 2), np.nan)], ids=["shape", "flat", "nan"]
)
def test_scores_that_are_none_are_refused(learned, scores):
    active, _, _ = learned
    with pytest.raises(ModelError, match="scores"):
        replace(active.model, scores_mm=scores.astype(np.float32))
