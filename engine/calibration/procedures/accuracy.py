"""Accuracy of a pair's calibration, in mm on a chest at 850 mm, from the pictures themselves.

The fit is repeated without one group of pictures after the other (delete-a-group jackknife); the spread of the results
is their uncertainty, independent of the cause of the corners' errors. Two results are evaluated: the position in the
colour picture of a point that the depth camera sees at 850 mm, and the length of 100 mm.
"""

from dataclasses import dataclass

import numpy as np

from engine.calibration.procedures.boards import Board
from engine.calibration.procedures.stereo_pair import PairFit, PictureSizes, fit_together
from engine.core.frames import FloatArray

AT_MM = 850.0
MOST_GROUPS = 8
# The part of the depth picture that a patient fills: the middle, in shares of width and height.
_PART = (0.2, 0.8)
_GRID = 7


@dataclass(frozen=True, slots=True, kw_only=True)
class PairAccuracy:
    """Uncertainty of a calibration at 850 mm; standard deviations, in the middle of the picture.

    Parameters
    ----------
    residual_px, residual_mm
        Distance between the two cameras' positions of a corner, root mean square over all pictures, with
        corner noise.
    alignment_px, alignment_mm
        Uncertainty of where a depth pixel lies in the colour picture, root mean square and, ``_worst_``, largest.
    scale_mm
        Uncertainty of a length of 100 mm across the picture.
    groups
        Number of repeated fits.
    """

    residual_px: float
    residual_mm: float
    alignment_px: float
    alignment_mm: float
    alignment_worst_mm: float
    scale_mm: float
    groups: int


def judge_pair(board: Board, fit: PairFit, sizes: PictureSizes) -> PairAccuracy:
    """Judge a fit by fitting it again without each group of its pictures."""
    groups = min(MOST_GROUPS, len(fit.pairs))
    mapped, spans = [], []
    for group in range(groups):
        kept = [pair for i, pair in enumerate(fit.pairs) if i % groups != group]
        depth, color, color_from_depth = fit_together(board, fit, kept)
        rays = depth.rays(_grid_px(sizes)) * AT_MM
        mapped.append(color.project(color_from_depth.apply(rays)))
        spans.append(float(np.linalg.norm(rays[-1] - rays[0])))
    moved_px = np.sqrt(_variance(np.stack(mapped)).sum(axis=-1))
    scale_mm = 100.0 * float(np.sqrt(_variance(np.array(spans)))) / float(np.mean(spans))
    mm_a_px = AT_MM / fit.color.intrinsics.fx
    residual_px = float(np.sqrt(np.square(fit.alignment_px).sum(axis=-1).mean()))
    alignment_px = float(np.sqrt(np.square(moved_px).mean()))
    return PairAccuracy(
        residual_px=residual_px,
        residual_mm=residual_px * mm_a_px,
        alignment_px=alignment_px,
        alignment_mm=alignment_px * mm_a_px,
        alignment_worst_mm=float(moved_px.max()) * mm_a_px,
        scale_mm=scale_mm,
        groups=groups,
    )


def _variance(again: FloatArray) -> FloatArray:
    """Jackknife variance over the first axis."""
    groups = len(again)
    return np.asarray(np.square(again - again.mean(axis=0)).sum(axis=0) * (groups - 1) / groups)


def _grid_px(sizes: PictureSizes) -> FloatArray:
    sides = [np.linspace(_PART[0] * side, _PART[1] * side, _GRID) for side in sizes.depth]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
