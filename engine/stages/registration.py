"""Which depth pixel sees what a colour pixel sees (article, section 4.2).

The article aligns whole depth pictures with the colour camera: 300,000 pixels for a region that needs a few hundred.
Here only the nodes of the region are aligned: a colour pixel's ray is cut at the depth expected there, and that point
is projected into the depth camera, distortion included. Alignment moves by about 0.02 px a millimetre of depth, so the
expected depth may be some millimetres old.
"""

import numpy as np

from engine.calibration import Calibration
from engine.frames import FloatArray
from engine.geometry import Intrinsics


def undistorted_rays(camera: Intrinsics, step_px: int) -> FloatArray:
    """Tabulate a camera's rays on a lattice of ``step_px``, from pixel (0, 0) to beyond the last.

    Returns
    -------
    FloatArray
        (x/z, y/z) at pixel (step * j, step * i), shape (rows, columns, 2), float64.
    """
    columns = np.arange(0, camera.width + step_px, step_px, dtype=np.float64)
    rows = np.arange(0, camera.height + step_px, step_px, dtype=np.float64)
    x, y = np.meshgrid(columns, rows)
    rays = camera.rays(np.column_stack([x.ravel(), y.ravel()]))
    return np.ascontiguousarray(rays[:, :2].reshape(len(rows), len(columns), 2))


def look_up_rays(table: FloatArray, step_px: int, pixels_px: FloatArray) -> FloatArray:
    """Interpolate :func:`undistorted_rays` at pixels (x, y), shape (N, 2); beyond the picture, extrapolate."""
    scaled = pixels_px / step_px
    corner = np.clip(scaled.astype(np.intp), 0, (table.shape[1] - 2, table.shape[0] - 2))
    fx, fy = (scaled - corner).T[:, :, None]
    j, i = corner.T
    upper = table[i, j] * (1.0 - fx) + table[i, j + 1] * fx
    lower = table[i + 1, j] * (1.0 - fx) + table[i + 1, j + 1] * fx
    return np.asarray(upper * (1.0 - fy) + lower * fy)


def align(rays: FloatArray, expected_depth_mm: FloatArray, calibration: Calibration) -> FloatArray:
    """Find where the depth camera sees the points that colour rays hit.

    Parameters
    ----------
    rays
        Rays of the colour camera (x/z, y/z), shape (N, 2).
    expected_depth_mm
        Depth expected there, along the depth camera's axis [mm], shape (N,).

    Returns
    -------
    FloatArray
        Pixels (x, y) of the depth picture [px], shape (N, 2).
    """
    depth_from_color = calibration.color_from_depth.inverse
    directions = rays @ depth_from_color.rotation[:, :2].T + depth_from_color.rotation[:, 2]
    along = (expected_depth_mm - depth_from_color.translation_mm[2]) / directions[:, 2]
    points = along[:, None] * directions + depth_from_color.translation_mm
    return calibration.depth.project(points)
