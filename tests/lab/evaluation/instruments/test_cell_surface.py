"""A surface read between its cells."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from lab.evaluation.instruments.laser_line import CellSurface

ROWS, COLUMNS = np.mgrid[0:350, 0:200].astype(float)
PLACES = np.column_stack([np.linspace(3.0, 346.0, 57), np.linspace(196.0, 3.0, 57)])


def means(surface, cell_px):
    rows, columns = np.arange(0, 350, cell_px), np.arange(0, 200, cell_px)
    sums = np.add.reduceat(np.add.reduceat(surface, rows, axis=0), columns, axis=1)
    sizes = np.outer(np.diff(np.append(rows, 350)), np.diff(np.append(columns, 200)))
    return sums / sizes


def chest(row, column):
    """Millimetres of shape as a shirt has it: a slope, a dome and creases of 30 grid points."""
    dome = 60.0 * ((row - 175.0) / 200.0) ** 2 + 30.0 * ((column - 90.0) / 110.0) ** 2
    return 850.0 + dome + 0.1 * row + 1.4 * np.cos(2.0 * np.pi * (0.8 * row + 0.6 * column) / 30.0)


@pytest.mark.parametrize(("cell_px", "bound_mm"), [(5, 0.05), (10, 0.35)])
def test_creases_are_read_between_cells_as_they_are(cell_px, bound_mm):
    value, _, _ = CellSurface(cell_px).values(means(chest(ROWS, COLUMNS), cell_px), PLACES)
    assert np.abs(value - chest(*PLACES.T)).max() < bound_mm


def test_a_mean_over_a_cell_is_no_value_at_its_middle():
    """What the splines are for: straight lines between the cells' middles miss the creases several times as far."""
    cells = means(chest(ROWS, COLUMNS), 5)
    straight = map_coordinates(cells, (PLACES.T - 2.0) / 5.0, order=1, mode="nearest")
    splines, _, _ = CellSurface(5).values(cells, PLACES)
    assert np.abs(straight - chest(*PLACES.T)).max() > 4.0 * np.abs(splines - chest(*PLACES.T)).max()


@pytest.mark.parametrize("cell_px", [5, 25, 30, 64])
def test_a_slope_is_read_exactly_with_cells_of_any_size(cell_px):
    tilted = 800.0 + 0.3 * ROWS - 0.2 * COLUMNS
    value, down, across = CellSurface(cell_px).values(means(tilted, cell_px), PLACES)
    assert value == pytest.approx(800.0 + 0.3 * PLACES[:, 0] - 0.2 * PLACES[:, 1])
    assert down == pytest.approx(np.full(57, 0.3))
    assert across == pytest.approx(np.full(57, -0.2))


def test_slopes_are_those_of_the_surface_read():
    cells, step = means(chest(ROWS, COLUMNS), 5), 0.01
    surface = CellSurface(5)
    _, down, across = surface.values(cells, PLACES)
    for axis, slope in ((0, down), (1, across)):
        shift = np.eye(2)[axis] * step
        difference = surface.values(cells, PLACES + shift)[0] - surface.values(cells, PLACES - shift)[0]
        assert slope == pytest.approx(difference / (2.0 * step), abs=1e-3)


def test_off_the_grid_and_in_an_unknown_cell_there_is_no_value():
    cells = means(800.0 + 0.3 * ROWS, 5)
    cells[10, 10] = np.nan
    places = np.array(
        [[52.0, 52.0], [52.0, 57.0], [-0.1, 5.0], [349.2, 5.0], [5.0, 199.1], [np.nan, np.nan], [0.0, 0.0]]
    )
    value, down, across = CellSurface(5).values(cells, places)
    assert np.isfinite(value).tolist() == [False, True, False, False, False, False, True]
    assert value[1] == pytest.approx(800.0 + 0.3 * 52.0, abs=0.3)
    assert np.isnan(down[0])
    assert np.isnan(across[0])
    nothing = CellSurface(5).values(np.full((70, 40), np.nan), places)
    assert all(np.isnan(part).all() for part in nothing)
