"""The anatomically consistent region: 350 rows by 200 columns between the four markers (article, section 4.2).

Row 0 is superior, column 0 the patient's right. The projective map of the markers' quadrilateral is evaluated exactly
at nodes every 25 pixels and bilinearly between them. A validity mask goes through the same warp, so holes do not enter
the interpolation of their neighbours.

Registration of colour pixels to the depth camera (article, section 4.2).

The article registers whole depth pictures to the colour camera: 300,000 pixels for a region that needs a few hundred.
Here only the nodes of the region are registered: the point at the expected depth on a colour pixel's ray is projected
into the depth camera, distortion included. The result changes by about 0.02 px per mm of depth, so the expected depth
may be some millimetres out of date.
"""

import math
from dataclasses import dataclass
from functools import cache, lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import (
    NODE_COLUMNS,
    NODE_ROWS,
    NODE_STEP,
    ROI_COLUMNS,
    ROI_ROWS,
    BoolArray,
    DepthImage,
    FloatArray,
    RoiDepth,
)
from engine.core.geometry import Intrinsics, RigidTransform

IndexArray = npt.NDArray[np.intp]
MIN_VALID_WEIGHT = 0.5
MIN_WHOLLY_VALID_SHARE = 0.8
# Replaces the zero determinant of three collinear markers; the resulting region lies outside of any picture.
DEGENERATE = 1e-9
_NODES = np.stack(np.meshgrid(np.arange(NODE_COLUMNS) * NODE_STEP, np.arange(NODE_ROWS) * NODE_STEP), axis=-1).astype(
    np.float64
)
_NODES_FLAT = _NODES.reshape(-1, 2)


def _hat_weights(size: int) -> FloatArray:
    """Bilinear weights from nodes to pixels, shape (size, nodes)."""
    pixels = np.arange(size)[:, None] / NODE_STEP
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(pixels - np.arange(size // NODE_STEP + 1))))


_ROW_WEIGHTS = _hat_weights(ROI_ROWS)
_COLUMN_WEIGHTS = _hat_weights(ROI_COLUMNS)


def color_from_roi(centers_px: FloatArray) -> FloatArray:
    """Return the homography from the grid (column, row) to colour pixels (x, y), shape (3, 3)."""
    return color_from_grid(centers_px, ROI_COLUMNS - 1.0, ROI_ROWS - 1.0)


def color_from_grid(centers_px: FloatArray, right: float, bottom: float) -> FloatArray:
    """Return the homography from a grid, whose last column and row are ``right`` and ``bottom``, to colour pixels.

    In closed form, for speed (Heckbert, Fundamentals of texture mapping and image warping, 1989, section 2.2.3).
    """
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = centers_px.tolist()
    sum_x, sum_y = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    dx1, dy1, dx2, dy2 = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    determinant = dx1 * dy2 - dx2 * dy1 or DEGENERATE
    g, h = (sum_x * dy2 - dx2 * sum_y) / determinant, (dx1 * sum_y - sum_x * dy1) / determinant
    return np.array(
        [
            [(x1 - x0 + g * x1) / right, (x3 - x0 + h * x3) / bottom, x0],
            [(y1 - y0 + g * y1) / right, (y3 - y0 + h * y3) / bottom, y0],
            [g / right, h / bottom, 1.0],
        ]
    )


def roi_nodes(centers_px: FloatArray) -> FloatArray:
    """Return the colour pixels (x, y) of the region's nodes [px], shape (nodes, 2)."""
    homography = color_from_grid(centers_px, ROI_COLUMNS - 1.0, ROI_ROWS - 1.0)
    compiled = FramePath.kernels
    if compiled is not None:
        nodes_px = np.empty(_NODES_FLAT.shape)
        compiled.map_points(homography, _NODES_FLAT, nodes_px)
        return nodes_px
    points = _NODES_FLAT @ homography[:, :2].T + homography[:, 2]
    return points[:, :2] / points[:, 2:]


def at_nodes(surface: FloatArray | BoolArray, stride_px: int = 1) -> FloatArray:
    """Sample a surface on the grid, shape (350, 200) or thinned by ``stride_px``, at the nodes, shape (nodes,).

    The nearest sample is taken; the last row and column repeat.
    """
    return np.ascontiguousarray(surface[_samples_at_nodes(*surface.shape, stride_px)], dtype=np.float64).ravel()


@lru_cache(maxsize=16)
def _samples_at_nodes(rows: int, columns: int, stride_px: int) -> tuple[IndexArray, ...]:
    return np.ix_(
        np.minimum(np.arange(NODE_ROWS) * NODE_STEP // stride_px, rows - 1),
        np.minimum(np.arange(NODE_COLUMNS) * NODE_STEP // stride_px, columns - 1),
    )


def cut_out(depth_mm: DepthImage, nodes_px: FloatArray, table_mm: FloatArray, stride_px: int = 1) -> RoiDepth:
    """Sample a depth picture on the region's grid.

    Parameters
    ----------
    depth_mm
        Raw depth [mm], shape (H, W), uint16; 0 is "no reading".
    nodes_px
        Depth pixels (x, y) of the nodes, shape (nodes, 2).
    table_mm
        Depth of each of the 65536 readings [mm], float32, NaN for none: quantisation undone, scale corrected.
    stride_px
        Sample every ``stride_px``-th row and column of the grid.

    Returns
    -------
    RoiDepth
        A point is valid where all four depth pixels around it have a reading; if too few points have, then where
        readings carry at least half of the interpolation weight. Holes never enter the interpolation.
    """
    compiled = FramePath.kernels
    if compiled is None:
        return _cut_out(depth_mm, nodes_px, table_mm, stride_px)
    shape = -(-ROI_ROWS // stride_px), -(-ROI_COLUMNS // stride_px)
    depth, valid = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.bool_)
    compiled.cut_out(
        np.ascontiguousarray(depth_mm),
        np.ascontiguousarray(nodes_px),
        table_mm,
        stride_px,
        MIN_VALID_WEIGHT,
        MIN_WHOLLY_VALID_SHARE,
        depth,
        valid,
    )
    return RoiDepth(depth_mm=depth, valid=valid, stride_px=stride_px)


def _cut_out(depth_mm: DepthImage, nodes_px: FloatArray, table_mm: FloatArray, stride_px: int) -> RoiDepth:
    """Sample with numpy and OpenCV."""
    lows, highs = nodes_px.min(axis=0).tolist(), nodes_px.max(axis=0).tolist()
    rows, columns = _weights(stride_px)
    if all(map(math.isfinite, lows + highs)):
        left, top = (max(int(low) - 1, 0) for low in lows)
        right, bottom = (max(int(high) + 3, 0) for high in highs)
    else:  # a node outside of the depth camera's view or behind it
        left, top, right, bottom = 0, 0, 0, 0
    # Copy first: a sequential copy brings a cold picture into the cache three times as fast as the look-up does.
    window = np.ascontiguousarray(depth_mm[top:bottom, left:right])
    if min(window.shape) < 2:
        empty = np.zeros((len(rows), len(columns)), dtype=np.float32)
        return RoiDepth(depth_mm=empty, valid=np.zeros_like(empty, dtype=np.bool_), stride_px=stride_px)
    nodes = (nodes_px - (left, top)).T.reshape(2, NODE_ROWS, NODE_COLUMNS)
    x, y = (rows @ nodes @ columns.T).astype(np.float32)
    window_mm = np.asarray(cv2.LUT(window, table_mm), dtype=np.float32)
    depth, valid = _interpolate_complete(window_mm, x, y)
    if np.count_nonzero(valid) < MIN_WHOLLY_VALID_SHARE * valid.size:
        depth, valid = _interpolate_partial(window_mm, x, y)
    return RoiDepth(depth_mm=depth, valid=valid, stride_px=stride_px)


def _interpolate_complete(window_mm: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Interpolate where all four pixels around a point have a reading."""
    sum_mm = cv2.remap(window_mm, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,))
    valid = np.asarray(sum_mm > 0.0)  # a hole is NaN, and the comparison with NaN is false
    return np.where(valid, sum_mm, np.float32(0.0)), valid


def _interpolate_partial(window_mm: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Interpolate where readings carry at least half of a point's interpolation weight."""
    # Depth and validity are interpolated alike, so their quotient is the mean of the valid readings alone.
    is_seen = window_mm > 0.0
    sum_mm = cv2.remap(np.where(is_seen, window_mm, np.float32(0.0)), x, y, cv2.INTER_LINEAR)
    valid_weight = np.asarray(cv2.remap(is_seen.astype(np.float32), x, y, cv2.INTER_LINEAR), dtype=np.float32)
    valid = valid_weight >= MIN_VALID_WEIGHT
    depth = np.asarray(sum_mm, dtype=np.float32) / np.maximum(valid_weight, MIN_VALID_WEIGHT)
    return np.where(valid, depth, np.float32(0.0)), valid


@cache
def _weights(stride_px: int) -> tuple[FloatArray, FloatArray]:
    return np.ascontiguousarray(_ROW_WEIGHTS[::stride_px]), np.ascontiguousarray(_COLUMN_WEIGHTS[::stride_px])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Aligned:
    """Points in the depth camera: pixels (x, y) [px] and rays (x/z, y/z), both of shape (N, 2)."""

    pixels_px: FloatArray
    rays: FloatArray


def align(
    color_rays: FloatArray, expected_depth_mm: FloatArray, depth_from_color: RigidTransform, depth_camera: Intrinsics
) -> Aligned:
    """Project the points on colour rays into the depth camera.

    Parameters
    ----------
    color_rays
        Rays of the colour camera (x/z, y/z, 1), shape (N, 3).
    expected_depth_mm
        Expected depth along the depth camera's axis [mm], shape (N,).
    """
    compiled = FramePath.kernels
    if compiled is None:
        return _align(color_rays, expected_depth_mm, depth_from_color, depth_camera)
    pixels_px, rays = np.empty((2, len(color_rays), 2))
    compiled.align_nodes(
        np.ascontiguousarray(color_rays),
        np.ascontiguousarray(expected_depth_mm),
        np.ascontiguousarray(depth_from_color.rotation),
        np.ascontiguousarray(depth_from_color.translation_mm),
        depth_camera.constants,
        pixels_px,
        rays,
    )
    return Aligned(pixels_px=pixels_px, rays=rays)


def _align(
    color_rays: FloatArray, expected_depth_mm: FloatArray, depth_from_color: RigidTransform, depth_camera: Intrinsics
) -> Aligned:
    """Project with numpy."""
    directions = color_rays @ depth_from_color.rotation.T
    along = (expected_depth_mm - depth_from_color.translation_mm[2]) / directions[:, 2]
    points = along[:, None] * directions + depth_from_color.translation_mm
    return Aligned(pixels_px=depth_camera.project(points), rays=points[:, :2] / points[:, 2:])
