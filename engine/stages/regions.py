"""From coefficients to millimetres per region (article, section 4.4.2).

Region means are linear in the coefficients, so they are worked out once a model: no frame rebuilds 70,000 pixels to
average them. ``motion = reference - current``: positive is towards the camera, inhale.
"""

from dataclasses import dataclass

import numpy as np

from engine.errors import InvalidValueError
from engine.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, frozen

MIN_CELL_PX = 5
MAX_CELL_PX = 100
MIN_KNOWN_SHARE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegionMeans:
    """Means over the cells of a grid, row by row, then whole, thorax, abdomen, then single points.

    Attributes
    ----------
    mean_mm
        Of the model's mean surface, shape (cells + 3 + points,).
    modes
        Of each mode, shape (cells + 3 + points, modes).
    is_known
        Whether enough of the cell was ever seen, same order.
    """

    rows: int
    columns: int
    mean_mm: FloatArray
    modes: FloatArray
    is_known: BoolArray

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.mean_mm, self.modes, self.is_known):
            frozen(array)

    def depth_mm(self, coefficients: FloatArray) -> FloatArray:
        """Mean depth of every region [mm], shape (cells + 3 + points,); NaN where the model knows nothing."""
        depth = self.mean_mm + self.modes @ coefficients
        return np.where(self.is_known, depth, np.nan)

    @property
    def cells(self) -> int:
        """How many cells the grid has."""
        return self.rows * self.columns


def grid_shape(cell_px: int) -> tuple[int, int]:
    """Rows and columns of cells of ``cell_px``; the last may be smaller."""
    if not MIN_CELL_PX <= cell_px <= MAX_CELL_PX:
        raise InvalidValueError("cell", cell_px, f"from {MIN_CELL_PX} to {MAX_CELL_PX} px")
    return -(-ROI_ROWS // cell_px), -(-ROI_COLUMNS // cell_px)


def check_points(points: list[tuple[int, int]]) -> None:
    """Refuse points (row, column) that lie off the grid."""
    for row, column in points:
        if not (0 <= row < ROI_ROWS and 0 <= column < ROI_COLUMNS):
            raise InvalidValueError(
                "point", f"{row},{column}", f"row 0 to {ROI_ROWS - 1}, column 0 to {ROI_COLUMNS - 1}"
            )


def prepare_regions(
    mean_mm: FloatArray,
    modes: FloatArray,
    known: BoolArray,
    *,
    cell_px: int,
    thorax_rows: int,
    points: list[tuple[int, int]],
) -> RegionMeans:
    """Average a model's surfaces over every region once.

    Parameters
    ----------
    mean_mm, modes, known
        On the grid, shapes (350, 200), (modes, 350, 200), (350, 200).
    thorax_rows
        Rows 0 to ``thorax_rows - 1`` are thorax, the rest abdomen.
    """
    rows, columns = grid_shape(cell_px)
    surfaces = np.concatenate([mean_mm[None], modes]).astype(np.float64)
    share = region_values(known[None].astype(np.float64), cell_px, thorax_rows, points)[0]
    means = region_values(surfaces, cell_px, thorax_rows, points)
    is_known = share >= MIN_KNOWN_SHARE
    return RegionMeans(rows=rows, columns=columns, mean_mm=means[0].copy(), modes=means[1:].T.copy(), is_known=is_known)


def region_values(surfaces: FloatArray, cell_px: int, thorax_rows: int, points: list[tuple[int, int]]) -> FloatArray:
    """Average surfaces, shape (n, 350, 200), over cells, whole, thorax, abdomen and points: (n, cells + 3 + points)."""
    row_starts, column_starts = np.arange(0, ROI_ROWS, cell_px), np.arange(0, ROI_COLUMNS, cell_px)
    sums = np.add.reduceat(np.add.reduceat(surfaces, row_starts, axis=1), column_starts, axis=2)
    sizes = np.outer(np.diff(np.append(row_starts, ROI_ROWS)), np.diff(np.append(column_starts, ROI_COLUMNS)))
    cells = (sums / sizes).reshape(len(surfaces), -1)
    parts = [surfaces, surfaces[:, :thorax_rows], surfaces[:, thorax_rows:]]
    wide = np.stack([part.mean(axis=(1, 2)) for part in parts], axis=1)
    at = np.array(points, dtype=np.intp).reshape(-1, 2)
    return np.concatenate([cells, wide, surfaces[:, at[:, 0], at[:, 1]]], axis=1)
