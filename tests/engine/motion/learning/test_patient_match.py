"""A stored model is refused by the first figure beyond its bound, and accepted at the bound itself."""

import math
from dataclasses import replace

import pytest

from engine.core.errors import InvalidValueError
from engine.core.learning_status import PatientMatch
from engine.motion.learning.patient_match import PATIENT_MATCH_BOUNDS, PatientMatchLimits, with_refusal

LIMITS = PatientMatchLimits()
AT_THE_BOUNDS = PatientMatch(
    frames=20,
    explained_share=0.8,
    residual_mm=3.0,
    shift_mm=(0.0, 12.0, 16.0),
    tilt_deg=5.0,
    shape_mm=3.0,
)
"""A shift of (0, 12, 16) is 20 mm long."""


def test_figures_at_their_bounds_are_accepted():
    assert with_refusal(AT_THE_BOUNDS, LIMITS) == AT_THE_BOUNDS


@pytest.mark.parametrize(
    ("changes", "field", "value", "bound", "advice"),
    [
        ({"explained_share": 0.79}, "model.explained_share", "0.79", "at least 0.8", "another patient"),
        ({"explained_share": math.nan}, "model.explained_share", "nan", "at least 0.8", "another patient"),
        ({"shift_mm": (0.0, 12.0, 16.2)}, "model.shift_mm", "20.2", "at most 20", "position differs"),
        ({"tilt_deg": 5.1}, "model.tilt_deg", "5.1", "at most 5", "position differs"),
        ({"shape_mm": 3.1}, "model.shape_mm", "3.1", "at most 3", "another patient"),
        ({"residual_mm": 3.1}, "model.residual_mm", "3.1", "at most 3", "another patient"),
        ({"residual_mm": None}, "model.residual_mm", "not known", "at most 3", "another patient"),
        ({"tilt_deg": math.nan}, "model.tilt_deg", "nan", "at most 5", "position differs"),
    ],
)
def test_a_figure_beyond_its_bound_is_named_with_value_bound_and_advice(changes, field, value, bound, advice):
    refusal = with_refusal(replace(AT_THE_BOUNDS, **changes), LIMITS).refusal
    assert (refusal.field, refusal.value, refusal.bound) == (field, value, bound)
    assert advice in str(refusal)


def test_the_first_of_several_is_named():
    """What cannot be explained at all comes before where it lies, and where it lies before whose it is."""
    worse = replace(AT_THE_BOUNDS, explained_share=0.1, tilt_deg=9.0, shape_mm=9.0)
    assert with_refusal(worse, LIMITS).refusal.field == "model.explained_share"
    assert with_refusal(replace(worse, explained_share=1.0), LIMITS).refusal.field == "model.tilt_deg"


@pytest.mark.parametrize("name", PATIENT_MATCH_BOUNDS)
def test_every_limit_is_bounded_on_both_sides(name):
    low, high = PATIENT_MATCH_BOUNDS[name]
    for value in (low, high):
        assert getattr(PatientMatchLimits(**{name: value}), name) == value
    for value in (math.nextafter(low, -math.inf), math.nextafter(high, math.inf), math.nan):
        with pytest.raises(InvalidValueError, match=name):
            PatientMatchLimits(**{name: value})
