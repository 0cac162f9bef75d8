"""The article's preprocessing of training frames: filling of small holes and smoothing (section 4.3.1)."""

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, FloatArray, RoiDepth

FILL_REACH = 2
FILL_NEIGHBOURS = 8
FILL_PASSES = 3
BILATERAL_DIAMETER = 7
BILATERAL_RANGE_MM = 6.0
BILATERAL_SPACE_PX = 3.0

IndexArray = npt.NDArray[np.signedinteger]


def fill_holes(roi: RoiDepth) -> RoiDepth:
    """Zero-elimination mode filter: a hole takes the mode of its valid neighbours, in whole millimetres.

    In each of three passes a hole is filled if at least 8 of its 24 neighbours are valid; larger holes stay masked.
    """
    depth, valid = roi.depth_mm.copy(), roi.valid.copy()
    for _ in range(FILL_PASSES):
        rows, columns = np.nonzero(~valid)
        if rows.size == 0 or not _fill_once(depth, valid, rows, columns):
            break
    return RoiDepth(depth_mm=depth, valid=valid)


def _fill_once(depth: FloatArray, valid: BoolArray, rows: IndexArray, columns: IndexArray) -> bool:
    reach = FILL_REACH
    span = np.arange(2 * reach + 1)
    around = np.ix_(span, span)
    rounded = np.pad(np.where(valid, np.rint(depth), 0.0).astype(np.int32), reach)
    neighbours = np.stack(
        [rounded[rows + i, columns + j] for i in around[0].ravel() for j in around[1].ravel()], axis=1
    )
    enough = (neighbours > 0).sum(axis=1) >= FILL_NEIGHBOURS
    rows, columns, neighbours = rows[enough], columns[enough], neighbours[enough]
    if rows.size:
        depth[rows, columns] = _mode(neighbours)
        valid[rows, columns] = True
    return bool(rows.size)


def _mode(values: npt.NDArray[np.int32]) -> FloatArray:
    """Return the most frequent positive value of each row; of several, the smallest."""
    ordered = np.sort(values, axis=1)
    counts = (ordered[:, :, None] == ordered[:, None, :]).sum(axis=2)
    counts[ordered <= 0] = 0
    commonest: FloatArray = ordered[np.arange(len(ordered)), counts.argmax(axis=1)].astype(np.float32)
    return commonest


def smooth_bilateral(roi: RoiDepth) -> RoiDepth:
    """Apply the edge-preserving bilateral filter; holes do not contribute."""
    if not roi.valid.any():
        return roi
    # Depth of holes: far enough for the resolution of the filter's table.
    hole_mm = float(roi.depth_mm[roi.valid].max()) + 20.0 * BILATERAL_RANGE_MM
    filled = np.where(roi.valid, roi.depth_mm, np.float32(hole_mm)).astype(np.float32)
    smooth = cv2.bilateralFilter(filled, BILATERAL_DIAMETER, BILATERAL_RANGE_MM, BILATERAL_SPACE_PX)
    return RoiDepth(depth_mm=np.where(roi.valid, smooth, np.float32(0.0)).astype(np.float32), valid=roi.valid.copy())
