"""The region's surface as means of measured cells, and its change in a few terms: breathing, height and tilt.

Nothing of the motion model is used: the means are of the frame's own readings, and the two shapes of breathing are
learned from such means. Breathing and a rigid movement span only five terms, so that they are told apart in a single
frame, at any moment of the breath; what they leave is neither.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray, RoiDepth, frozen

STRIDE_PX = 4
CELL_ROWS, CELL_COLUMNS = 8, 10
CELLS = CELL_ROWS * CELL_COLUMNS
LEAST_SEEN = 0.4
"""Least share of a cell's readings for its mean."""
BREATHING_SHAPES = 2
LEAST_CELLS = 20
LEAST_FRAMES = 60
"""Fewest frames to learn the shapes from: two seconds."""


class SurfaceChange(NamedTuple):
    """Change of the surface from one moment to another, in depth [mm].

    Attributes
    ----------
    height_mm
        Rigid change in the middle of the region, positive towards the camera.
    along_mm, across_mm
        Rigid change from the middle to the inferior edge, and to the patient's left edge.
    misfit_mm
        What breathing and a rigid movement leave of each cell's change, shape (cells,); NaN for cells not seen.
    """

    height_mm: float
    along_mm: float
    across_mm: float
    misfit_mm: FloatArray

    @property
    def spread_mm(self) -> float:
        """Root mean square of the misfit."""
        return float(np.sqrt(np.nanmean(self.misfit_mm**2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BreathingShapes:
    """The shapes of breathing at the cells, shape (2, cells), and the usual misfit of a training frame [mm]."""

    shapes: FloatArray
    misfit_mm: float

    def change(self, before_mm: FloatArray, now_mm: FloatArray) -> SurfaceChange | None:
        """Return the change between two surfaces of cell means [mm], shape (cells,); None with too few common cells."""
        difference = now_mm - before_mm
        terms = np.concatenate([_PLANE, self.shapes])
        is_seen = np.isfinite(difference) & np.isfinite(self.shapes).all(axis=0)
        if np.count_nonzero(is_seen) < LEAST_CELLS:
            return None
        weights = np.linalg.lstsq(terms[:, is_seen].T, difference[is_seen], rcond=None)[0]
        misfit_mm = np.where(is_seen, difference - weights @ np.nan_to_num(terms), np.nan)
        height, along, across = (-weights[:3]).tolist()
        return SurfaceChange(height_mm=height, along_mm=along, across_mm=across, misfit_mm=misfit_mm)


def learn_shapes(surfaces_mm: FloatArray) -> BreathingShapes | None:
    """Learn the shapes of breathing from measured surfaces, shape (frames, cells); None if they are too few."""
    if len(surfaces_mm) < LEAST_FRAMES:
        return None
    is_seen = np.isfinite(surfaces_mm).mean(axis=0) > 0.9
    if np.count_nonzero(is_seen) < LEAST_CELLS:
        return None
    mean_mm = np.full(CELLS, np.nan)
    mean_mm[is_seen] = np.nanmean(surfaces_mm[:, is_seen], axis=0)
    changes = np.nan_to_num(surfaces_mm[:, is_seen] - mean_mm[is_seen])
    shapes = np.full((BREATHING_SHAPES, CELLS), np.nan)
    shapes[:, is_seen] = np.linalg.svd(changes, full_matrices=False)[2][:BREATHING_SHAPES]
    breathing = BreathingShapes(shapes=frozen(shapes), misfit_mm=0.0)
    found = [breathing.change(mean_mm, surface_mm) for surface_mm in surfaces_mm]
    spreads_mm = [change.spread_mm for change in found if change is not None]
    return BreathingShapes(shapes=shapes, misfit_mm=float(np.percentile(spreads_mm, 95.0))) if spreads_mm else None


def shapes_of(components: FloatArray, noise_mm: float) -> BreathingShapes:
    """Return the shapes of a stored model's components, shape (k, 350, 200), for a session that learned none itself.

    ``noise_mm`` is that of `engine.core.motion_model.MotionModel`.
    """
    found = [_means(one[::STRIDE_PX, ::STRIDE_PX], _ALL) for one in components[:BREATHING_SHAPES]]
    shapes = np.zeros((BREATHING_SHAPES, CELLS))
    shapes[: len(found)] = np.nan_to_num(np.array(found))
    pixels = ROI_ROWS * ROI_COLUMNS / CELLS
    return BreathingShapes(shapes=frozen(shapes), misfit_mm=noise_mm / math.sqrt(pixels))


def cell_means(roi: RoiDepth) -> FloatArray:
    """Return the mean depth of each cell [mm], row by row from superior right, shape (cells,); NaN if hardly seen."""
    thin = roi.thinned(STRIDE_PX)
    return _means(thin.depth_mm, thin.valid.astype(np.float32))


def _means(depth_mm: FloatArray, seen: FloatArray) -> FloatArray:
    sums = _ROWS @ np.where(seen > 0.0, depth_mm, 0.0) @ _COLUMNS
    counts = _ROWS @ seen @ _COLUMNS
    return np.where(counts >= LEAST_SEEN * _FULL, sums / np.maximum(counts, 1.0), np.nan).ravel()


def _sums() -> tuple[FloatArray, FloatArray]:
    """Return the matrices that sum the sampled rows and columns of each cell, shapes (8, 88) and (50, 10)."""
    rows, columns = np.arange(0, ROI_ROWS, STRIDE_PX), np.arange(0, ROI_COLUMNS, STRIDE_PX)
    return (
        (rows * CELL_ROWS // ROI_ROWS == np.arange(CELL_ROWS)[:, None]).astype(np.float32),
        ((columns * CELL_COLUMNS // ROI_COLUMNS)[:, None] == np.arange(CELL_COLUMNS)).astype(np.float32),
    )


_ROWS, _COLUMNS = _sums()
_ALL = np.ones((_ROWS.shape[1], _COLUMNS.shape[0]), dtype=np.float32)
_FULL = _ROWS @ _ALL @ _COLUMNS


def _plane() -> FloatArray:
    """Return height and both tilts at the cells, 1 at the inferior and left edges of the region, shape (3, cells)."""
    rows, columns = np.mgrid[0:CELL_ROWS, 0:CELL_COLUMNS].reshape(2, -1).astype(np.float64)
    along, across = (2.0 * rows + 1.0) / CELL_ROWS - 1.0, (2.0 * columns + 1.0) / CELL_COLUMNS - 1.0
    return np.stack([np.ones_like(along), along, across])


_PLANE = _plane()
