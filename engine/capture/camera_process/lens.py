"""OpenCV's parameters of a lens that an SDK describes in another way, by least squares."""

from collections.abc import Sequence

import numpy as np

from engine.core.frames import FloatArray
from engine.core.geometry import Intrinsics

GRID = 24


def grid_px(camera: Intrinsics) -> FloatArray:
    """Return pixels over the whole picture, shape (576, 2)."""
    columns, rows = np.meshgrid(np.linspace(0, camera.width - 1, GRID), np.linspace(0, camera.height - 1, GRID))
    return np.column_stack([columns.ravel(), rows.ravel()])


def fitted(camera: Intrinsics, pixels_px: FloatArray, rays: FloatArray) -> Intrinsics:
    """Return a camera with the distortion that shows rays (x, y at depth 1) at pixels, shapes (n, 2)."""
    x, y = rays.T
    away = (pixels_px - (camera.cx, camera.cy)) / (camera.fx, camera.fy) - rays
    squared = x**2 + y**2
    first, second, third = (np.concatenate([x * squared**power, y * squared**power]) for power in (1, 2, 3))
    along = np.concatenate([2.0 * x * y, squared + 2.0 * y**2])
    across = np.concatenate([squared + 2.0 * x**2, 2.0 * x * y])
    terms = np.column_stack([first, second, along, across, third])
    return with_distortion(camera, np.linalg.lstsq(terms, away.T.ravel(), rcond=None)[0])


def with_distortion(camera: Intrinsics, values: Sequence[float] | FloatArray) -> Intrinsics:
    """Return a camera with k1, k2, p1, p2 and k3."""
    k1, k2, p1, p2, k3 = (float(one) for one in values)
    return Intrinsics(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion=(k1, k2, p1, p2, k3),
    )
