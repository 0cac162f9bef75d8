"""The anatomically consistent region: 350 rows by 200 columns between the four markers (article, section 4.2).

Row 0 is superior, column 0 the patient's right. The projective map of the markers' quadrilateral is followed exactly at
nodes every 10 pixels and bilinearly between them. A hole is carried through the warp as a hole: nothing is interpolated
across it.
"""

import cv2
import numpy as np

from engine.frames import ROI_COLUMNS, ROI_ROWS, DepthImage, FloatArray, RoiDepth

NODE_STEP = 10
NODE_ROWS = ROI_ROWS // NODE_STEP + 1
NODE_COLUMNS = ROI_COLUMNS // NODE_STEP + 1

_CORNERS = np.array(
    [[0, 0], [ROI_COLUMNS - 1, 0], [ROI_COLUMNS - 1, ROI_ROWS - 1], [0, ROI_ROWS - 1]], dtype=np.float32
)


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
    """Return the homography from the grid (column, row) to colour pixels (x, y), shape (3, 3)."""
    return np.asarray(cv2.getPerspectiveTransform(_CORNERS, centers_px.astype(np.float32)), dtype=np.float64)


def roi_nodes(centers_px: FloatArray) -> FloatArray:
    """Return the colour pixels (x, y) of the region's nodes, shape (nodes, 2)."""
    homography = color_from_roi(centers_px)
    points = _NODES.reshape(-1, 2) @ homography[:, :2].T + homography[:, 2]
    return points[:, :2] / points[:, 2:]


def at_nodes(surface: FloatArray) -> FloatArray:
    """Sample a surface on the grid, shape (350, 200), at the nodes, shape (nodes,); the last row and column repeat."""
    rows = np.minimum(np.arange(NODE_ROWS) * NODE_STEP, ROI_ROWS - 1)
    columns = np.minimum(np.arange(NODE_COLUMNS) * NODE_STEP, ROI_COLUMNS - 1)
    return np.ascontiguousarray(surface[np.ix_(rows, columns)], dtype=np.float64).ravel()


def cut_out(depth_mm: DepthImage, nodes_px: FloatArray) -> RoiDepth:
    """Sample a depth picture on the region's grid.

    Parameters
    ----------
    depth_mm
        Raw depth [mm], shape (H, W), uint16; 0 is "no reading".
    nodes_px
        Depth pixels (x, y) of the nodes, shape (nodes, 2).

    Returns
    -------
    RoiDepth
        Valid where all four depth pixels around a grid point have a reading.
    """
    left, top = (max(int(value) - 1, 0) for value in np.floor(nodes_px.min(axis=0)))
    right, bottom = (max(int(value) + 2, 0) for value in np.ceil(nodes_px.max(axis=0)))
    window = depth_mm[top:bottom, left:right].astype(np.float32)
    if min(window.shape) < 2:
        empty = np.zeros((ROI_ROWS, ROI_COLUMNS), dtype=np.float32)
        return RoiDepth(depth_mm=empty, valid=np.zeros_like(empty, dtype=np.bool_))
    window[window == 0.0] = np.nan
    nodes = nodes_px.reshape(NODE_ROWS, NODE_COLUMNS, 2).astype(np.float32)
    x = _ROW_WEIGHTS @ (nodes[:, :, 0] - left) @ _COLUMN_WEIGHTS.T
    y = _ROW_WEIGHTS @ (nodes[:, :, 1] - top) @ _COLUMN_WEIGHTS.T
    depth = cv2.remap(window, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,))
    valid = np.isfinite(depth)
    return RoiDepth(depth_mm=np.where(valid, depth, np.float32(0.0)), valid=valid)
