"""Finds a red laser line in a colour picture to a fraction of a pixel (article, section 4.5.2).

The article smooths the red channel and fits a parabola to each column. The red channel alone also peaks on white
stickers and other bright objects. Here a pixel counts as line only where red exceeds green and blue, its surroundings,
and every other peak of the column; the parabola is fitted there.

"Column" refers to a line that runs across the picture; for a vertical line (``is_upright``) it means row.

Tidegate's surface between its cells: depth at any point of the ROI grid from means over cells.

The mean over a cell is not the value at its centre: over a crease of the shirt they differ by tenths of a millimetre.
The surface is therefore the spline with the given cell means: the derivative of a cubic spline through their cumulative
sum, along rows and along columns.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.ndimage import distance_transform_edt

from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, ColorImage, FloatArray, frozen

Map = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSettings:
    """Criteria of a laser line.

    Attributes
    ----------
    across_sigma_px, along_sigma_px
        Gaussian smoothing across and along the line [px].
    width_px
        Largest width of the line [px].
    min_contrast
        Least excess of red over green and blue, relative to its surroundings [levels of 255]. White stickers and a
        saturated core have none.
    max_rival
        Largest height of a second peak in the column, as a share of the first; beyond, the column is ambiguous.
    max_step_px
        Largest distance of a point from the median line through its neighbours [px].
    is_on_pattern
        Fit the parabola to the excess of red over green and blue, which a printed pattern shifts less than red. JPEG
        stores that difference at half the resolution, so on cloth and skin red alone is better by a third.
    neighbours
        Number of neighbours on each side for ``max_step_px``.
    """

    across_sigma_px: float = 1.5
    along_sigma_px: float = 0.8
    width_px: int = 15
    min_contrast: float = 25.0
    max_rival: float = 0.6
    max_step_px: float = 2.5
    is_on_pattern: bool = False
    neighbours: int = 9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserLine:
    """A line found in a picture; at most one point per column.

    Attributes
    ----------
    pixels_px
        Points (x, y) in the picture [px], in the order of the columns, shape (n, 2), float64; n may be 0.
    contrast
        Excess of red at each point [levels], shape (n,).
    """

    pixels_px: FloatArray
    contrast: FloatArray

    def __post_init__(self) -> None:
        """Make both arrays read-only."""
        frozen(self.pixels_px)
        frozen(self.contrast)


DEFAULT_SETTINGS = LineSettings()


def find_line(
    color: ColorImage,
    region: BoolArray,
    *,
    is_upright: bool = False,
    settings: LineSettings = DEFAULT_SETTINGS,
) -> LaserLine:
    """Find the laser line inside a region of the picture.

    Parameters
    ----------
    color
        RGB, shape (H, W, 3).
    region
        Pixels to search, shape (H, W).
    is_upright
        Whether the line is vertical in the picture, so that it is searched along rows.
    """
    window = _window(region, settings.width_px)
    if window is None:
        return _line(np.zeros((0, 2)), np.zeros(0))
    patch, inside = color[window], region[window]
    if is_upright:
        patch, inside = patch.transpose(1, 0, 2), inside.T
    rows, contrast = _find_rows(np.ascontiguousarray(patch), np.ascontiguousarray(inside), settings)
    is_found = np.isfinite(rows)
    columns = np.flatnonzero(is_found).astype(np.float64)
    places = np.column_stack([rows[is_found], columns] if is_upright else [columns, rows[is_found]])
    return _line(places + np.array([window[1].start, window[0].start]), contrast[is_found])


def _line(pixels_px: FloatArray, contrast: FloatArray) -> LaserLine:
    return LaserLine(pixels_px=pixels_px.astype(np.float64), contrast=contrast.astype(np.float64))


def _window(region: BoolArray, margin_px: int) -> tuple[slice, slice] | None:
    """Rows and columns that contain the region and the margin for the filters."""
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    if rows.size == 0:
        return None
    return (
        slice(max(int(rows[0]) - margin_px, 0), int(rows[-1]) + 1 + margin_px),
        slice(max(int(columns[0]) - margin_px, 0), int(columns[-1]) + 1 + margin_px),
    )


def _find_rows(patch: ColorImage, inside: BoolArray, settings: LineSettings) -> tuple[FloatArray, FloatArray]:
    """Row of the line in each column, NaN where there is none, and its contrast; both of shape (columns,)."""
    smooth = cv2.GaussianBlur(
        patch.astype(np.float32), (0, 0), sigmaX=settings.along_sigma_px, sigmaY=settings.across_sigma_px
    )
    red, green, blue = (np.asarray(smooth[..., channel], dtype=np.float32) for channel in range(3))
    excess = red - np.float32(0.5) * (green + blue)
    # The top-hat removes structures wider than a line, such as skin.
    narrow = np.ones((settings.width_px, 1), np.uint8)
    ridge = np.asarray(cv2.morphologyEx(excess, cv2.MORPH_TOPHAT, narrow), dtype=np.float32)
    ridge[~inside] = -1.0
    ridge[[0, -1]] = -1.0
    columns = np.arange(ridge.shape[1])
    peak = ridge.argmax(axis=0)
    contrast = ridge[peak, columns]
    is_line = contrast >= settings.min_contrast
    is_line &= _rival(ridge, peak, settings) <= settings.max_rival * contrast
    rows = np.where(is_line, peak + _parabola(excess if settings.is_on_pattern else red, peak), np.nan)
    return _without_strays(rows, settings), contrast


def _rival(ridge: Map, peak: npt.NDArray[np.intp], settings: LineSettings) -> Map:
    """Height of the highest other peak of each column."""
    away = np.abs(np.arange(ridge.shape[0])[:, None] - peak)
    return np.asarray(np.where(away > settings.width_px // 2, ridge, np.float32(0.0)).max(axis=0))


def _parabola(signal: Map, peak: npt.NDArray[np.intp]) -> FloatArray:
    """Offset of the vertex of a parabola through three samples from ``peak`` [px]; NaN where there is no maximum."""
    columns = np.arange(signal.shape[1])
    # The peaks of red and of its excess may be a pixel apart.
    inner = np.clip(peak, 2, signal.shape[0] - 3)
    near = np.stack([signal[inner + step, columns] for step in (-1, 0, 1)])
    middle = inner + near.argmax(axis=0) - 1
    before, top, after = (signal[middle + step, columns].astype(np.float64) for step in (-1, 0, 1))
    bend = before - 2.0 * top + after
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = 0.5 * (before - after) / bend
    return np.where((bend < 0.0) & (np.abs(offset) <= 1.0), middle - peak + offset, np.nan)


def _without_strays(rows: FloatArray, settings: LineSettings) -> FloatArray:
    """Remove points far from the median line through their neighbours, and points with few neighbours."""
    reach = settings.neighbours
    padded = np.pad(rows, reach, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    count = np.isfinite(around).sum(axis=1)
    # The slope is removed before the median, since a line may be oblique.
    middle = np.full(len(rows), np.nan)
    enough = count >= reach // 2 + 1
    middle[enough] = np.nanmedian(around[enough] - _slope(around[enough]) * np.arange(-reach, reach + 1), axis=1)
    return np.where(np.abs(rows - middle) <= settings.max_step_px, rows, np.nan)


def _slope(around: FloatArray) -> FloatArray:
    """Least-squares slope of each row of points, NaN ones left out, shape (n, 1)."""
    is_there = np.isfinite(around)
    at = np.where(is_there, np.arange(around.shape[1], dtype=np.float64), np.nan)
    at -= np.nanmean(at, axis=1, keepdims=True)
    spread = np.nansum(at * at, axis=1, keepdims=True)
    return np.asarray(np.nansum(at * around, axis=1, keepdims=True) / np.maximum(spread, 1e-9))


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
