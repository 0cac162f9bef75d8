"""Converts coefficients to mean depth per region [mm] (article, section 4.4.2).

Region means are linear in the coefficients, so they are precomputed once per model instead of averaging 70,000
reconstructed pixels in every frame. ``motion = reference - current``: positive is towards the camera, inhale.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from engine.core.errors import InvalidValueError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, frozen
from engine.motion.named_regions import MIN_AREA_PX, NamedRegion, check_regions, coverage

MIN_CELL_PX = 5
MAX_CELL_PX = 100
MIN_KNOWN_SHARE = 0.5
POINT_SURROUNDINGS_PX = 21
MIN_PART_ROWS = 35
MIDDLE_SPLIT = (174.5, 174.5)
WIDE = ("whole", "thorax", "abdomen")


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionLayout:
    """Regions that motion is averaged over, validated when it is made.

    Attributes
    ----------
    cell_px
        Side of a cell of the region grid [px].
    split
        Rows at which the line between thorax and abdomen crosses columns 0 and 199 of the grid.
    points
        Single grid points (row, column) to report.
    named
        Named polygons to report.
    """

    cell_px: int = 25
    split: tuple[float, float] = MIDDLE_SPLIT
    points: tuple[tuple[int, int], ...] = ()
    named: tuple[NamedRegion, ...] = ()

    def __post_init__(self) -> None:
        """Check all regions against the grid; raise InvalidValueError."""
        grid_shape(self.cell_px)
        check_points(list(self.points))
        check_split(self.split)
        check_regions(self.named)


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionMeans:
    """Means over the cells of a grid, row by row, then whole, thorax, abdomen, then single points, then named regions.

    Attributes
    ----------
    mean_mm
        Means of the model's mean surface [mm], shape (cells + 3 + points + named,).
    modes
        Means of each mode, shape (cells + 3 + points + named, modes).
    is_known
        Whether the model covers enough of the region, shape (cells + 3 + points + named,).
    """

    layout: RegionLayout
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
        """Mean depth of every region [mm], shape (cells + 3 + points + named,); NaN for unknown regions."""
        return np.where(self.is_known, self.model_depth_mm(coefficients), np.nan)

    def model_depth_mm(self, coefficients: FloatArray) -> FloatArray:
        """Return the same as `depth_mm`, with the model's extrapolation in unknown regions."""
        depth: FloatArray = self.mean_mm + self.modes @ coefficients
        return depth

    @cached_property
    def cells(self) -> int:
        """Number of cells of the grid."""
        return self.rows * self.columns

    @cached_property
    def ends(self) -> tuple[int, int, int]:
        """Where the cells end, the wide regions and the single points; named regions come last."""
        cells = self.rows * self.columns
        return cells, cells + len(WIDE), cells + len(WIDE) + len(self.layout.points)


def grid_shape(cell_px: int) -> tuple[int, int]:
    """Return the rows and columns of cells of ``cell_px``, the last ones possibly smaller; raise InvalidValueError."""
    if not MIN_CELL_PX <= cell_px <= MAX_CELL_PX:
        raise InvalidValueError("cell", cell_px, f"from {MIN_CELL_PX} to {MAX_CELL_PX} px")
    return -(-ROI_ROWS // cell_px), -(-ROI_COLUMNS // cell_px)


def check_points(points: list[tuple[int, int]]) -> None:
    """Raise InvalidValueError for a point (row, column) off the grid."""
    for row, column in points:
        if not (0 <= row < ROI_ROWS and 0 <= column < ROI_COLUMNS):
            raise InvalidValueError(
                "point", f"{row},{column}", f"row 0 to {ROI_ROWS - 1}, column 0 to {ROI_COLUMNS - 1}"
            )


def check_split(split: tuple[float, float]) -> None:
    """Raise InvalidValueError for a line that leaves thorax or abdomen fewer than `MIN_PART_ROWS` rows."""
    for row in split:
        if not MIN_PART_ROWS <= row <= ROI_ROWS - MIN_PART_ROWS:
            bound = f"rows {MIN_PART_ROWS} to {ROI_ROWS - MIN_PART_ROWS} at both sides"
            raise InvalidValueError("split", ",".join(f"{value:g}" for value in split), bound)


def horizontal_split(thorax_rows: int) -> tuple[float, float]:
    """Return the line below row ``thorax_rows - 1``."""
    return thorax_rows - 0.5, thorax_rows - 0.5


def prepare_regions(mean_mm: FloatArray, modes: FloatArray, known: BoolArray, layout: RegionLayout) -> RegionMeans:
    """Precompute the means of a model's surfaces over every region.

    Parameters
    ----------
    mean_mm, modes, known
        On the grid, shapes (350, 200), (modes, 350, 200), (350, 200).
    """
    rows, columns = grid_shape(layout.cell_px)
    share = region_values(known[None].astype(np.float64), layout)[0]
    # A point in a small hole is known from its surroundings, as shapes are smooth; in a large hole it is not.
    around = cv2.blur(known.astype(np.float32), (POINT_SURROUNDINGS_PX, POINT_SURROUNDINGS_PX))
    at = np.array(layout.points, dtype=np.intp).reshape(-1, 2)
    points = slice(rows * columns + len(WIDE), rows * columns + len(WIDE) + len(at))
    share[points] = around[at[:, 0], at[:, 1]]
    means = region_values(np.concatenate([mean_mm[None], modes]).astype(np.float64), layout)
    return RegionMeans(
        layout=layout,
        rows=rows,
        columns=columns,
        mean_mm=means[0].copy(),
        modes=means[1:].T.copy(),
        is_known=share >= _needed_share(layout, len(share)),
    )


def region_values(surfaces: FloatArray, layout: RegionLayout) -> FloatArray:
    """Average surfaces, shape (n, 350, 200), over every region; shape (n, cells + 3 + points + named)."""
    row_starts, column_starts = np.arange(0, ROI_ROWS, layout.cell_px), np.arange(0, ROI_COLUMNS, layout.cell_px)
    sums = np.add.reduceat(np.add.reduceat(surfaces, row_starts, axis=1), column_starts, axis=2)
    sizes = np.outer(np.diff(np.append(row_starts, ROI_ROWS)), np.diff(np.append(column_starts, ROI_COLUMNS)))
    cells = (sums / sizes).reshape(len(surfaces), -1)
    flat = surfaces.reshape(len(surfaces), -1)
    wide = [flat.mean(axis=1)] + [flat @ weights for weights in _part_weights(layout.split)]
    named = [flat @ _weights(region.vertices) for region in layout.named]
    at = np.array(layout.points, dtype=np.intp).reshape(-1, 2)
    return np.column_stack([cells, *wide, surfaces[:, at[:, 0], at[:, 1]], *named])


def thorax_coverage(split: tuple[float, float]) -> FloatArray:
    """Share of each pixel superior to the line, shape (350, 200), 0 to 1."""
    right, left = split
    overhang = 0.5 * (left - right) / (ROI_COLUMNS - 1)
    right_edge = ROI_COLUMNS - 0.5
    return coverage(((-0.5, -0.5), (-0.5, right_edge), (left + overhang, right_edge), (right - overhang, -0.5)))


def _needed_share(layout: RegionLayout, regions: int) -> FloatArray:
    """Return the least known share of each region: half of it, and of a small polygon no less area than a cell's."""
    needed = np.full(regions, MIN_KNOWN_SHARE)
    for position, region in enumerate(layout.named, start=regions - len(layout.named)):
        needed[position] = max(MIN_KNOWN_SHARE, min(MIN_AREA_PX / float(coverage(region.vertices).sum()), 1.0 - 1e-9))
    return needed


def _part_weights(split: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    thorax = thorax_coverage(split).ravel()
    return thorax / thorax.sum(), (1.0 - thorax) / (1.0 - thorax).sum()


def _weights(vertices: tuple[tuple[float, float], ...]) -> FloatArray:
    inside = coverage(vertices).ravel()
    return np.asarray(inside / inside.sum())
