"""Known moves of a virtual volunteer are found by the surface, wherever the markers were put back."""

from functools import cache

import numpy as np
import pytest

from engine.core.frames import NODE_COLUMNS, NODE_ROWS
from engine.motion.learning.position_fit import COLUMNS, ROWS, body_axes, position_between
from lab.phantom.falsifications import Move
from tests.support.evaluation.fractions import Fraction

VOLUNTEERS = (1, 3)
MOVES = (
    Move(),
    *(Move(x_mm=mm) for mm in (1.0, -5.0)),
    *(Move(y_mm=mm) for mm in (-1.0, 5.0)),
    *(Move(up_mm=mm) for mm in (1.0, -5.0)),
    *(Move(tilt_deg=deg) for deg in (0.5, -3.0)),
    *(Move(roll_deg=deg) for deg in (-0.5, 3.0)),
    *(Move(turn_deg=deg) for deg in (0.5, -3.0)),
    Move(x_mm=20.0, y_mm=-25.0, up_mm=10.0, turn_deg=4.0),
)
OFF_MM = 4.0
"""Markers that are put back so far elsewhere, together and each by itself."""
BARE_SKIN_MM = 5.0


@cache
def plan_surface(volunteer):
    return Fraction(volunteer=volunteer).resting_surface()


def errors(fraction, **how):
    """Return the errors of the six degrees of freedom, and the fit."""
    first_mm = plan_surface(fraction.volunteer)
    fit = position_between(first_mm, fraction.resting_surface(), **{"marker_placement_mm": BARE_SKIN_MM, **how})
    assert fit is not None
    return np.concatenate([fit.shift_mm, fit.turn_deg]) - fraction.moved(first_mm), fit


def uncertainty(fit):
    return np.concatenate([fit.shift_uncertainty_mm, fit.turn_uncertainty_deg])


@pytest.mark.parametrize("volunteer", VOLUNTEERS)
@pytest.mark.parametrize("move", MOVES, ids=str)
def test_a_known_move_is_found_with_the_markers_where_they_were(volunteer, move):
    error, fit = errors(Fraction(volunteer=volunteer, move=move))
    assert np.abs(error[:2]).max() < 0.3
    assert abs(error[2]) < 0.05
    assert np.abs(error[3:]).max() < 0.15
    assert fit.shape_mm < 0.3


@pytest.mark.parametrize("volunteer", VOLUNTEERS)
@pytest.mark.parametrize("seed", range(4))
def test_markers_put_back_elsewhere_are_not_taken_for_the_patient(volunteer, seed):
    rng = np.random.default_rng(seed)
    offsets_mm = rng.normal(0.0, OFF_MM, (4, 2)) if seed else np.full((4, 2), [OFF_MM, -OFF_MM])
    for move in MOVES[1:3]:
        error, fit = errors(Fraction(volunteer=volunteer, move=move, offsets_mm=offsets_mm))
        assert np.abs(error[:2]).max() < 1.5
        assert abs(error[2]) < 0.2
        assert np.abs(error[3:]).max() < 0.5
        assert (np.abs(error) < 2.0 * uncertainty(fit)).all()


@pytest.mark.parametrize("volunteer", [*VOLUNTEERS, 6])
def test_nodes_that_lie_a_third_of_their_distance_elsewhere_are_laid_on_the_curved_surface(volunteer):
    offsets_mm = np.full((4, 2), [8.0, -8.0])
    fraction = Fraction(volunteer=volunteer, move=Move(x_mm=3.0), offsets_mm=offsets_mm)
    error, _ = errors(fraction, marker_placement_mm=50.0)
    assert np.abs(error[:2]).max() < 1.5
    assert abs(error[2]) < 0.2
    assert np.abs(error[3:]).max() < 0.5


def test_markers_on_tattoos_determine_a_slide_and_bare_skin_states_that_it_does_not():
    offsets_mm = np.full((4, 2), [OFF_MM, -OFF_MM])
    fraction = Fraction(volunteer=1, offsets_mm=offsets_mm)
    _, bare = errors(fraction)
    _, tattooed = errors(Fraction(volunteer=1), marker_placement_mm=1.0)
    assert bare.shift_uncertainty_mm[:2].min() > 1.0  # twice that is beyond 2 mm
    assert tattooed.shift_uncertainty_mm[:2].max() < 1.0
    assert bare.shift_uncertainty_mm[2] < 0.3


def test_a_smooth_surface_does_not_determine_a_slide_along_it():
    rows, columns = np.meshgrid(np.linspace(-150.0, 150.0, NODE_ROWS), np.linspace(-100.0, 100.0, NODE_COLUMNS))
    rows, columns = rows.T, columns.T
    bent = np.stack([columns, rows, 800.0 + columns**2 / 400.0], axis=-1).reshape(-1, 3)  # a cylinder along the body
    fit = position_between(bent, bent + np.array([0.0, -5.0, -1.0]), marker_placement_mm=BARE_SKIN_MM)
    assert fit is not None
    assert fit.shift_uncertainty_mm[1] > 4.0  # along the cylinder: what the markers are worth, no more
    assert fit.shift_uncertainty_mm[2] < 0.3
    assert fit.shift_mm[2] == pytest.approx(1.0, abs=0.05)


def test_axes_are_those_of_a_patient_on_the_back():
    grid = plan_surface(1).reshape(NODE_ROWS, NODE_COLUMNS, 3)[:ROWS, :COLUMNS]
    left, head, up = body_axes(grid)
    assert left @ (grid[:, -1] - grid[:, 0]).mean(axis=0) > 0.0
    assert head @ (grid[0] - grid[-1]).mean(axis=0) > 0.0
    assert up[2] < 0.0
    assert np.allclose(np.cross(left, head), up)


def test_a_surface_with_holes_and_one_that_is_elsewhere_are_not_compared():
    first_mm = plan_surface(1)
    holed = first_mm.copy()
    holed[3] = np.nan
    assert position_between(first_mm, holed, marker_placement_mm=BARE_SKIN_MM) is None
    assert position_between(holed, first_mm, marker_placement_mm=BARE_SKIN_MM) is None


def test_another_body_is_no_rigid_move():
    fit = position_between(plan_surface(1), plan_surface(4), marker_placement_mm=BARE_SKIN_MM)
    assert fit is None or fit.shape_mm > 2.0
