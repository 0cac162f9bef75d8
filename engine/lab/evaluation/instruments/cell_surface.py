"""Tidegate's surface between its cells: depth at any point of the ROI grid from means over cells.

The mean over a cell is not the value at its centre: over a crease of the shirt they differ by tenths of a millimetre.
The surface is therefore the spline with the given cell means: the derivative of a cubic spline through their cumulative
sum, along rows and along columns.
"""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import distance_transform_edt

from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray


class CellSurface:
    """Interpolates surfaces given as means over cells of ``cell_px`` grid points, shape (rows, columns) of cells."""

    def __init__(self, cell_px: int) -> None:
        self.cell_px = cell_px
        self._row_edges, self._column_edges = _edges(ROI_ROWS, cell_px), _edges(ROI_COLUMNS, cell_px)

    def values(self, cells: FloatArray, places_rc: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Interpolate a surface at points of the grid.

        Parameters
        ----------
        cells
            Means over the cells, shape (rows, columns); NaN where unknown.
        places_rc
            Points (row, column), fractions allowed, shape (n, 2); NaN for none.

        Returns
        -------
        tuple
            Values, and their slopes per grid point along rows and along columns, each of shape (n,); NaN off the grid
            and in a cell without a value.
        """
        is_known = np.isfinite(cells)
        inside = self._is_inside(places_rc) & is_known.any()
        rows, columns = np.where(inside[:, None], places_rc, 0.0).T
        at = np.clip(
            (places_rc[inside] / self.cell_px + 0.5 / self.cell_px).astype(np.intp), 0, np.array(cells.shape) - 1
        )
        inside[np.flatnonzero(inside)[~is_known[at[:, 0], at[:, 1]]]] = False
        if not inside.any():
            nothing = np.full(len(places_rc), np.nan)
            return nothing, nothing, nothing
        sums = np.cumsum(_filled(cells, is_known) * np.diff(self._row_edges)[:, None], axis=0)
        down = CubicSpline(self._row_edges, np.concatenate([np.zeros((1, sums.shape[1])), sums]))
        across = [self._along_columns(down(rows, order), columns) for order in (1, 2)]
        value, row_slope, column_slope = across[0][0], across[1][0], across[0][1]
        return (
            np.where(inside, value, np.nan),
            np.where(inside, row_slope, np.nan),
            np.where(inside, column_slope, np.nan),
        )

    def _along_columns(self, lines: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Interpolate each line of cells, shape (n, cells), at its own column: value and slope, shapes (n,)."""
        sums = np.cumsum(lines * np.diff(self._column_edges), axis=1)
        spline = CubicSpline(self._column_edges, np.column_stack([np.zeros(len(lines)), sums]), axis=1)
        piece = np.clip(np.searchsorted(self._column_edges, columns, side="right") - 1, 0, lines.shape[1] - 1)
        step = columns - self._column_edges[piece]
        cubic, square, line, _ = spline.c[:, piece, np.arange(len(lines))]
        return 3.0 * cubic * step**2 + 2.0 * square * step + line, 6.0 * cubic * step + 2.0 * square

    def _is_inside(self, places_rc: FloatArray) -> BoolArray:
        last = np.array([ROI_ROWS - 1.0, ROI_COLUMNS - 1.0])
        return np.asarray(((places_rc >= 0.0) & (places_rc <= last)).all(axis=1))


def _edges(points: int, cell_px: int) -> FloatArray:
    """Edges of the cells in grid points: point k extends from k - 0.5 to k + 0.5."""
    return np.append(np.arange(0.0, points, cell_px), float(points)) - 0.5


def _filled(cells: FloatArray, is_known: BoolArray) -> FloatArray:
    """Give unknown cells the value of the nearest known one, so that a spline can pass by."""
    if is_known.all():
        return cells.astype(np.float64)
    nearest = distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    return np.asarray(cells[tuple(nearest)], dtype=np.float64)
