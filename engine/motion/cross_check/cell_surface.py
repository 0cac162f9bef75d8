"""The region's surface as means of measured cells, and its change in a few terms: breathing, height and tilt.

Nothing of the motion model is used: the means are of the frame's own readings, and the two shapes of breathing are
learned from such means. A third term shifts breathing between thorax and abdomen: the first shape, weighted along the
body, since a breath hold or an isovolume manoeuvre would pass for a movement of the patient otherwise. Breathing and a
rigid movement span only six terms, so that one frame distinguishes them, at any moment of the breath. A body that
breathes more deeply than in the training bends smoothly: the second shape along the body and terms of second and third
order are added for that. What is left then is an edge.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from engine.core.compiled import FramePath
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, RoiDepth, frozen
from engine.core.geometry import least_squares

STRIDE_PX = 4
CELL_ROWS, CELL_COLUMNS = 8, 10
CELLS = CELL_ROWS * CELL_COLUMNS
LEAST_SEEN = 0.4
"""Least share of a cell's readings for its mean."""
BREATHING_SHAPES = 2
FIRST_TERMS = 6
"""Height, two tilts, two shapes of breathing and the first of them weighted along the body; the bends come behind."""
LEAST_CELLS = 20
LEAST_FRAMES = 60
"""Fewest frames to learn the shapes from: two seconds."""
AVERAGED_FRAMES = 3
"""Consecutive frames averaged for the usual misfit: the fewest that are compared, at 15 frames a second."""
_CELL_OF_ROW = np.arange(0, ROI_ROWS, STRIDE_PX, dtype=np.int64) * CELL_ROWS // ROI_ROWS
_CELL_OF_COLUMN = np.arange(0, ROI_COLUMNS, STRIDE_PX, dtype=np.int64) * CELL_COLUMNS // ROI_COLUMNS


class SurfaceChange(NamedTuple):
    """Change of the surface from one moment to another, in depth [mm].

    Attributes
    ----------
    height_mm
        Rigid change in the middle of the region, positive towards the camera.
    along_mm, across_mm
        Rigid change from the middle to the inferior edge, and to the patient's left edge.
    breath_mm
        Root mean square of the change by breathing.
    redistributed_mm
        Root mean square of its part that is shifted between thorax and abdomen, other than in the training.
    misfit_mm
        What breathing, a rigid movement and a smooth bend leave of each cell's change, shape (cells,); NaN for cells
        not seen.
    spread_mm
        Root mean square of the misfit.
    """

    height_mm: float
    along_mm: float
    across_mm: float
    breath_mm: float
    redistributed_mm: float
    misfit_mm: FloatArray
    spread_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BreathingShapes:
    """The shapes of breathing at the cells.

    Attributes
    ----------
    shapes
        Shape (2, cells); NaN for cells that were not seen.
    misfit_mm
        The usual misfit in the training.
    reach_mm
        Largest change by breathing between two frames of the training, root mean square over the cells.
    terms
        Height and tilts, both shapes, both weighted along the body, and the bends, shape (13, cells).
    """

    shapes: FloatArray
    misfit_mm: float
    reach_mm: float
    terms: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Put the terms of every fit together."""
        redistributed = self.shapes * _ALONG
        terms = np.concatenate([_PLANE, self.shapes, redistributed, _BENDS])
        object.__setattr__(self, "terms", frozen(terms))

    def change(self, before_mm: FloatArray, now_mm: FloatArray) -> SurfaceChange | None:
        """Return the change between two surfaces of cell means [mm], shape (cells,); None with too few common cells."""
        compiled = FramePath.kernels
        if compiled is None:
            return self._change(now_mm - before_mm)
        weights, misfit_mm, spreads_mm = np.empty(FIRST_TERMS), np.empty(CELLS), np.empty(3)
        is_fitted = compiled.surface_change(
            self.terms, now_mm - before_mm, FIRST_TERMS, LEAST_CELLS, weights, misfit_mm, spreads_mm
        )
        if is_fitted is None:  # shapes that depend on each other
            return self._change(now_mm - before_mm)
        if not is_fitted:
            return None
        height, along, across = (-weights[:3]).tolist()
        breath_mm, redistributed_mm, spread_mm = spreads_mm.tolist()
        return SurfaceChange(height, along, across, breath_mm, redistributed_mm, misfit_mm, spread_mm)

    def _change(self, difference: FloatArray) -> SurfaceChange | None:
        """Return the change with numpy."""
        redistributed = self.shapes * _ALONG
        breathing = np.concatenate([self.shapes, redistributed[:1]])
        terms = np.concatenate([_PLANE, breathing])
        is_seen = np.isfinite(difference) & np.isfinite(self.shapes).all(axis=0)
        if np.count_nonzero(is_seen) < LEAST_CELLS:
            return None
        weights = least_squares(terms[:, is_seen], difference[is_seen])
        bent = np.concatenate([terms, redistributed[1:], _BENDS])[:, is_seen]
        misfit_mm = np.full(CELLS, np.nan)
        misfit_mm[is_seen] = difference[is_seen] - least_squares(bent, difference[is_seen]) @ bent
        height, along, across = (-weights[:3]).tolist()
        return SurfaceChange(
            height_mm=height,
            along_mm=along,
            across_mm=across,
            breath_mm=_rms(weights[3:] @ breathing[:, is_seen]),
            redistributed_mm=_rms(weights[-1] * breathing[-1, is_seen]),
            misfit_mm=misfit_mm,
            spread_mm=_rms(misfit_mm[is_seen]),
        )


def learn_shapes(surfaces_mm: FloatArray) -> BreathingShapes | None:
    """Learn the shapes of breathing from measured surfaces, shape (frames, cells); None if they are too few."""
    if len(surfaces_mm) < LEAST_FRAMES:
        return None
    is_seen = np.isfinite(surfaces_mm).mean(axis=0) > 0.9
    if np.count_nonzero(is_seen) < LEAST_CELLS:
        return None
    surfaces_mm = np.where(is_seen, surfaces_mm, np.nan)
    mean_mm = np.full(CELLS, np.nan)
    mean_mm[is_seen] = np.nanmean(surfaces_mm[:, is_seen], axis=0)
    changes = np.nan_to_num(surfaces_mm[:, is_seen] - mean_mm[is_seen])
    shapes = np.full((BREATHING_SHAPES, CELLS), np.nan)
    shapes[:, is_seen] = np.linalg.svd(changes, full_matrices=False)[2][:BREATHING_SHAPES]
    breathing = BreathingShapes(shapes=frozen(shapes), misfit_mm=0.0, reach_mm=0.0)
    whole = len(surfaces_mm) - len(surfaces_mm) % AVERAGED_FRAMES
    averaged_mm = surfaces_mm[:whole].reshape(-1, AVERAGED_FRAMES, CELLS).mean(axis=1)
    found = [change for change in (breathing.change(mean_mm, one) for one in averaged_mm) if change is not None]
    if not found:
        return None
    return BreathingShapes(
        shapes=shapes,
        misfit_mm=float(np.percentile([change.spread_mm for change in found], 95.0)),
        reach_mm=2.0 * max(change.breath_mm for change in found),
    )


class GatheredSurfaces(NamedTuple):
    """Surfaces that the shapes of breathing are learned from, shape (frames, cells) [mm]; ``total`` since the start."""

    total: int
    surfaces_mm: FloatArray

    def learn(self) -> "LearnedShapes":
        """Learn the shapes of breathing from them."""
        return LearnedShapes(self.total, learn_shapes(self.surfaces_mm))


class LearnedShapes(NamedTuple):
    """The shapes of breathing, if any, of what had been gathered until then; ``total`` as in `GatheredSurfaces`."""

    total: int
    shapes: BreathingShapes | None


class StoredModes(Protocol):
    """What a stored model gives to a session that has learned no shapes of breathing itself."""

    @property
    def components(self) -> FloatArray:
        """The ways it moves, on the region's grid, shape (k, 350, 200)."""

    @property
    def scores_mm(self) -> FloatArray | None:
        """Its training frames in terms of them, shape (frames, k); None where they were not kept."""

    @property
    def noise_mm(self) -> float:
        """The noise of a reading [mm]."""


def shapes_of(model: StoredModes) -> BreathingShapes:
    """Return the shapes of a stored model's first components, for a session that learned none itself."""
    found = [_means(one[::STRIDE_PX, ::STRIDE_PX], _ALL) for one in model.components[:BREATHING_SHAPES]]
    shapes = np.zeros((BREATHING_SHAPES, CELLS))
    shapes[: len(found)] = np.nan_to_num(np.array(found))
    pixels = ROI_ROWS * ROI_COLUMNS
    scores = model.scores_mm
    return BreathingShapes(
        shapes=frozen(shapes),
        misfit_mm=model.noise_mm / math.sqrt(pixels / CELLS),
        reach_mm=math.inf if scores is None or not len(scores) else float(np.ptp(scores[:, 0])) / math.sqrt(pixels),
    )


def cell_means(roi: RoiDepth) -> FloatArray:
    """Return the mean depth of each cell [mm], row by row from superior right, shape (cells,); NaN if hardly seen."""
    thin = roi if roi.stride_px == STRIDE_PX else roi.thinned(STRIDE_PX)
    compiled = FramePath.kernels
    if compiled is None:
        return _means(thin.depth_mm, thin.valid)
    means_mm = np.empty((CELL_ROWS, CELL_COLUMNS))
    depth_mm, valid = np.ascontiguousarray(thin.depth_mm), np.ascontiguousarray(thin.valid)
    compiled.cell_means(depth_mm, valid, _CELL_OF_ROW, _CELL_OF_COLUMN, _LEAST_SEEN, means_mm)
    return means_mm.ravel()


def _means(depth_mm: FloatArray, seen: BoolArray) -> FloatArray:
    sums = _ROWS @ np.where(seen, depth_mm, 0.0).astype(np.float64) @ _COLUMNS
    counts = _ROWS @ seen.astype(np.float64) @ _COLUMNS
    return np.where(counts >= _LEAST_SEEN, sums / np.maximum(counts, 1.0), np.nan).ravel()


def _sums() -> tuple[FloatArray, FloatArray]:
    """Return the matrices that sum the sampled rows and columns of each cell, shapes (8, 88) and (50, 10)."""
    return (
        (np.arange(CELL_ROWS)[:, None] == _CELL_OF_ROW).astype(np.float64),
        (_CELL_OF_COLUMN[:, None] == np.arange(CELL_COLUMNS)).astype(np.float64),
    )


_ROWS, _COLUMNS = _sums()
_ALL = np.ones((_ROWS.shape[1], _COLUMNS.shape[0]), dtype=np.bool_)
_LEAST_SEEN = LEAST_SEEN * (_ROWS @ _ALL @ _COLUMNS)


def _smooth_terms() -> tuple[FloatArray, FloatArray]:
    """Return height and both tilts at the cells, 1 at the inferior and left edges, shape (3, cells), and the bends.

    Bends are the second order and, along the body, the third, shape (6, cells).
    """
    rows, columns = np.mgrid[0:CELL_ROWS, 0:CELL_COLUMNS].reshape(2, -1).astype(np.float64)
    along, across = (2.0 * rows + 1.0) / CELL_ROWS - 1.0, (2.0 * columns + 1.0) / CELL_COLUMNS - 1.0
    second, third = [along**2, along * across, across**2], [along**3, along**2 * across, along * across**2]
    return np.stack([np.ones_like(along), along, across]), np.stack([*second, *third])


_PLANE, _BENDS = _smooth_terms()
_ALONG = _PLANE[1]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values * values)))
