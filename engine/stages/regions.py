"""From coefficients to millimetres per region (article, section 4.4.2).

Region means are linear in the coefficients, so they are worked out once a model: no frame rebuilds 70,000 pixels to
average them. ``motion = reference - current``: positive is towards the camera, inhale.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from engine.errors import InvalidValueError
from engine.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, frozen
from engine.polygons import MIN_AREA_PX, NamedRegion, check_regions, coverage

MIN_CELL_PX = 5
MAX_CELL_PX = 100
MIN_KNOWN_SHARE = 0.5
POINT_SURROUNDINGS_PX = 21
MIN_PART_ROWS = 35
MIDDLE_SPLIT = (174.5, 174.5)
WIDE = ("whole", "thorax", "abdomen")


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionLayout:
    """What motion is averaged over, checked once where it is made.

    Attributes
    ----------
    cell_px
        Side of a cell of the region grid [px].
    split
        Where the line between thorax and abdomen crosses column 0 and column 199 of the grid [row].
    points
        Grid points (row, column) to report singly.
    named
        Polygons to report, each under its name.
    """

    cell_px: int = 25
    split: tuple[float, float] = MIDDLE_SPLIT
    points: tuple[tuple[int, int], ...] = ()
    named: tuple[NamedRegion, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a layout that does not fit the grid."""
        grid_shape(self.cell_px)
        check_points(list(self.points))
        check_split(self.split)
        check_regions(self.named)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegionMeans:
    """Means over the cells of a grid, row by row, then whole, thorax, abdomen, then single points, then named regions.

    Attributes
    ----------
    mean_mm
        Of the model's mean surface, shape (cells + 3 + points + named,).
    modes
        Of each mode, shape (cells + 3 + points + named, modes).
    is_known
        Whether enough of the region was ever seen, same order.
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
        """Mean depth of every region [mm], shape (cells + 3 + points + named,); NaN where the model knows nothing."""
        return np.where(self.is_known, self.model_depth_mm(coefficients), np.nan)

    def model_depth_mm(self, coefficients: FloatArray) -> FloatArray:
        """Return the same as :meth:`depth_mm`, with what the model makes up where it knows nothing."""
        depth: FloatArray = self.mean_mm + self.modes @ coefficients
        return depth

    @property
    def cells(self) -> int:
        """How many cells the grid has."""
        return self.rows * self.columns

    @property
    def points_from(self) -> int:
        """Where the single points begin."""
        return self.cells + len(WIDE)

    @property
    def named_from(self) -> int:
        """Where the named regions begin; they are the last."""
        return self.points_from + len(self.layout.points)


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


def check_split(split: tuple[float, float]) -> None:
    """Refuse a line that leaves thorax or abdomen next to nothing."""
    for row in split:
        if not MIN_PART_ROWS <= row <= ROI_ROWS - MIN_PART_ROWS:
            bound = f"rows {MIN_PART_ROWS} to {ROI_ROWS - MIN_PART_ROWS} at both sides"
            raise InvalidValueError("split", ",".join(f"{value:g}" for value in split), bound)


def horizontal_split(thorax_rows: int) -> tuple[float, float]:
    """Return the line below row ``thorax_rows - 1``."""
    return thorax_rows - 0.5, thorax_rows - 0.5


def prepare_regions(mean_mm: FloatArray, modes: FloatArray, known: BoolArray, layout: RegionLayout) -> RegionMeans:
    """Average a model's surfaces over every region once.

    Parameters
    ----------
    mean_mm, modes, known
        On the grid, shapes (350, 200), (modes, 350, 200), (350, 200).
    """
    rows, columns = grid_shape(layout.cell_px)
    share = region_values(known[None].astype(np.float64), layout)[0]
    # A point in a small hole is told by what lies around it, as shapes are smooth; in a large one it is not.
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
    """Average surfaces, shape (n, 350, 200), over every region: (n, cells + 3 + points + named)."""
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
    """Share of each pixel that lies above the line, shape (350, 200)."""
    right, left = split
    overhang = 0.5 * (left - right) / (ROI_COLUMNS - 1)
    far = ROI_COLUMNS - 0.5
    return coverage(((-0.5, -0.5), (-0.5, far), (left + overhang, far), (right - overhang, -0.5)))


def _needed_share(layout: RegionLayout, regions: int) -> FloatArray:
    """Return the share of a region that has to be known: half of it, and of a small polygon no less than a cell's."""
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
