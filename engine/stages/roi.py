"""The anatomically consistent region: 350 rows by 200 columns between the four markers (article, section 4.2).

Row 0 is superior, column 0 the patient's right. The projective map of the markers' quadrilateral is followed exactly at
nodes every 25 pixels and bilinearly between them. A hole is carried through the warp as a hole: it takes no part in
what is interpolated beside it.
"""

from functools import cache

import cv2
import numpy as np

from engine.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, DepthImage, FloatArray, RoiDepth

NODE_STEP = 25
MIN_SIGHT = 0.5
MUCH_SEEN = 0.8
# Three markers in a line bound no region; what this makes of them lies outside of any picture.
DEGENERATE = 1e-9
NODE_ROWS = ROI_ROWS // NODE_STEP + 1
NODE_COLUMNS = ROI_COLUMNS // NODE_STEP + 1


def _hat_weights(size: int) -> FloatArray:
    """Bilinear weights from nodes to pixels, shape (size, nodes), float32."""
    pixels = np.arange(size)[:, None] / NODE_STEP
    return np.maximum(0.0, 1.0 - np.abs(pixels - np.arange(size // NODE_STEP + 1))).astype(np.float32)


_ROW_WEIGHTS = _hat_weights(ROI_ROWS)
_COLUMN_WEIGHTS = _hat_weights(ROI_COLUMNS)
_NODES = np.stack(np.meshgrid(np.arange(NODE_COLUMNS) * NODE_STEP, np.arange(NODE_ROWS) * NODE_STEP), axis=-1).astype(
    np.float64
)


def color_from_roi(centers_px: FloatArray) -> FloatArray:
    """Return the homography from the grid (column, row) to colour pixels (x, y), shape (3, 3).

    In closed form (Heckbert, Fundamentals of texture mapping and image warping, 1989, section 2.2.3): it is asked for
    on every frame.
    """
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = centers_px.tolist()
    sum_x, sum_y = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    dx1, dy1, dx2, dy2 = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    determinant = dx1 * dy2 - dx2 * dy1 or DEGENERATE
    g, h = (sum_x * dy2 - dx2 * sum_y) / determinant, (dx1 * sum_y - sum_x * dy1) / determinant
    right, bottom = ROI_COLUMNS - 1.0, ROI_ROWS - 1.0
    return np.array(
        [
            [(x1 - x0 + g * x1) / right, (x3 - x0 + h * x3) / bottom, x0],
            [(y1 - y0 + g * y1) / right, (y3 - y0 + h * y3) / bottom, y0],
            [g / right, h / bottom, 1.0],
        ]
    )


def roi_nodes(centers_px: FloatArray) -> FloatArray:
    """Return the colour pixels (x, y) of the region's nodes, shape (nodes, 2)."""
    homography = color_from_roi(centers_px)
    points = _NODES.reshape(-1, 2) @ homography[:, :2].T + homography[:, 2]
    return points[:, :2] / points[:, 2:]


def at_nodes(surface: FloatArray | BoolArray, stride_px: int = 1) -> FloatArray:
    """Sample a surface on the grid, shape (350, 200) or thinned, at the nodes, shape (nodes,); the last row repeats.

    ``stride_px`` says how the surface is thinned; the nearest point that was kept is taken.
    """
    rows, columns = (
        np.minimum(np.arange(count) * NODE_STEP // stride_px, size - 1)
        for count, size in zip((NODE_ROWS, NODE_COLUMNS), surface.shape, strict=True)
    )
    return np.ascontiguousarray(surface[np.ix_(rows, columns)], dtype=np.float64).ravel()


def cut_out(depth_mm: DepthImage, nodes_px: FloatArray, table_mm: FloatArray, stride_px: int = 1) -> RoiDepth:
    """Sample a depth picture on the region's grid.

    Parameters
    ----------
    depth_mm
        Raw depth [mm], shape (H, W), uint16; 0 is "no reading".
    nodes_px
        Depth pixels (x, y) of the nodes, shape (nodes, 2).
    table_mm
        What each of the 65536 readings means [mm], float32, NaN for none: the sensor's steps undone, its scale
        corrected.
    stride_px
        Sample every so many rows and columns of the grid.

    Returns
    -------
    RoiDepth
        Valid where all four depth pixels around a grid point have a reading; where too few points have, where at least
        half of what a point is interpolated from has one. A hole takes no part in either.
    """
    left, top = (max(int(low) - 1, 0) for low in nodes_px.min(axis=0).tolist())
    right, bottom = (max(int(high) + 3, 0) for high in nodes_px.max(axis=0).tolist())
    rows, columns = _weights(stride_px)
    # Copied first: a straight copy fetches a cold picture three times as fast as a look-up does.
    window = np.ascontiguousarray(depth_mm[top:bottom, left:right])
    if min(window.shape) < 2:
        empty = np.zeros((len(rows), len(columns)), dtype=np.float32)
        return RoiDepth(depth_mm=empty, valid=np.zeros_like(empty, dtype=np.bool_), stride_px=stride_px)
    nodes = (nodes_px - (left, top)).T.astype(np.float32, order="C").reshape(2, NODE_ROWS, NODE_COLUMNS)
    x, y = rows @ nodes @ columns.T
    window_mm = np.asarray(cv2.LUT(window, table_mm), dtype=np.float32)
    depth, valid = _wholly_seen(window_mm, x, y)
    if np.count_nonzero(valid) < MUCH_SEEN * valid.size:
        depth, valid = _partly_seen(window_mm, x, y)
    return RoiDepth(depth_mm=depth, valid=valid, stride_px=stride_px)


def _wholly_seen(window_mm: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Read where all four pixels around a point saw something: the cleanest readings."""
    sum_mm = cv2.remap(window_mm, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,))
    valid = np.asarray(sum_mm > 0.0)  # a hole is NaN, and NaN is not
    return np.where(valid, sum_mm, np.float32(0.0)), valid


def _partly_seen(window_mm: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Read where at least half of what a point is interpolated from saw something."""
    # Depth and sight are interpolated alike, so that their quotient is a mean of what was seen and of nothing else.
    is_seen = window_mm > 0.0
    sum_mm = cv2.remap(np.where(is_seen, window_mm, np.float32(0.0)), x, y, cv2.INTER_LINEAR)
    sight = np.asarray(cv2.remap(is_seen.astype(np.float32), x, y, cv2.INTER_LINEAR), dtype=np.float32)
    valid = sight >= MIN_SIGHT
    depth = np.asarray(sum_mm, dtype=np.float32) / np.maximum(sight, MIN_SIGHT)
    return np.where(valid, depth, np.float32(0.0)), valid


@cache
def _weights(stride_px: int) -> tuple[FloatArray, FloatArray]:
    return np.ascontiguousarray(_ROW_WEIGHTS[::stride_px]), np.ascontiguousarray(_COLUMN_WEIGHTS[::stride_px])
