"""What the article does to training frames, and to them alone: fill small holes, smooth (section 4.3.1)."""

import cv2
import numpy as np
import numpy.typing as npt

from engine.frames import BoolArray, FloatArray, RoiDepth

FILL_REACH = 2
FILL_NEIGHBOURS = 8
FILL_PASSES = 3
BILATERAL_DIAMETER = 7
BILATERAL_RANGE_MM = 6.0
BILATERAL_SPACE_PX = 3.0

IndexArray = npt.NDArray[np.signedinteger]


def fill_holes(roi: RoiDepth) -> RoiDepth:
    """Zero-elimination mode filter: a hole takes the mode of its valid neighbours, in whole millimetres.

    A hole with fewer than 8 of 24 valid neighbours stays a hole after each of three passes: a large hole is masked,
    never invented.
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
    """Return the commonest positive value of each row; the smallest of equals."""
    ordered = np.sort(values, axis=1)
    counts = (ordered[:, :, None] == ordered[:, None, :]).sum(axis=2)
    counts[ordered <= 0] = 0
    commonest: FloatArray = ordered[np.arange(len(ordered)), counts.argmax(axis=1)].astype(np.float32)
    return commonest


def smooth_bilateral(roi: RoiDepth) -> RoiDepth:
    """Edge-preserving bilateral filter in which holes take no part."""
    if not roi.valid.any():
        return roi
    # A hole is set so far away that its range weight vanishes, yet near enough to keep the filter's table fine.
    far = float(roi.depth_mm[roi.valid].max()) + 20.0 * BILATERAL_RANGE_MM
    filled = np.where(roi.valid, roi.depth_mm, np.float32(far)).astype(np.float32)
    smooth = cv2.bilateralFilter(filled, BILATERAL_DIAMETER, BILATERAL_RANGE_MM, BILATERAL_SPACE_PX)
    return RoiDepth(depth_mm=np.where(roi.valid, smooth, np.float32(0.0)).astype(np.float32), valid=roi.valid.copy())
