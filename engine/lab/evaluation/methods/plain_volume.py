"""The plain method's volume: mesh of region midpoints, prisms of three tetrahedra each (article, equation 8)."""

import cv2
import numpy as np
import numpy.typing as npt

from engine.calibration.camera_calibration import Calibration
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray

REGION_PX = 25
MM3_PER_L = 1e6
_ROWS, _COLUMNS = ROI_ROWS // REGION_PX, ROI_COLUMNS // REGION_PX


class PlainVolume:
    """Volume between the surface and the plane at the deepest midpoint of the first frame."""

    def __init__(self, calibration: Calibration) -> None:
        self._camera = calibration.color
        columns, rows = np.meshgrid(np.arange(_COLUMNS), np.arange(_ROWS))
        middles = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2) * REGION_PX + 0.5 * (REGION_PX - 1)
        self._middles = middles.astype(np.float32)
        self._triangles = _triangles()
        self._plane_mm: float | None = None
        self._first_l = 0.0

    def above_first_l(self, surface_mm: FloatArray, dots_px: FloatArray) -> float:
        """Volume of a surface, shape (350, 200) [mm], relative to the first one [l]; positive is inhale."""
        corners = np.array(
            [[0, 0], [ROI_COLUMNS - 1, 0], [ROI_COLUMNS - 1, ROI_ROWS - 1], [0, ROI_ROWS - 1]], dtype=np.float32
        )
        homography = cv2.getPerspectiveTransform(corners, dots_px.astype(np.float32))
        pixels = cv2.perspectiveTransform(self._middles, homography).reshape(-1, 2)
        depth = surface_mm.reshape(_ROWS, REGION_PX, _COLUMNS, REGION_PX).mean(axis=(1, 3)).ravel()
        points = self._camera.rays(np.asarray(pixels, dtype=np.float64)) * depth[:, None]
        if self._plane_mm is None:
            self._plane_mm = float(depth.max())
            self._first_l = prism_volume_l(points[self._triangles], self._plane_mm)
        return prism_volume_l(points[self._triangles], self._plane_mm) - self._first_l


def prism_volume_l(corners_mm: FloatArray, plane_mm: float) -> float:
    """Sum the prisms between triangles, shape (t, 3, 3), and their projections on the plane z = ``plane_mm`` [l]."""
    shadow = corners_mm.copy()
    shadow[:, :, 2] = plane_mm
    a, b, c = (corners_mm[:, i] for i in range(3))
    a0, b0, c0 = (shadow[:, i] for i in range(3))
    tetrahedra = np.concatenate([np.stack(four, axis=2) for four in ((a, b, c, a0), (b, c, a0, b0), (c, a0, b0, c0))])
    # Equation 8: a row of ones below the coordinates. The sign follows from the winding of the triangles.
    matrices = np.concatenate([tetrahedra, np.ones((len(tetrahedra), 1, 4))], axis=1)
    return -float(np.linalg.det(matrices).sum()) / 6.0 / MM3_PER_L


def _triangles() -> npt.NDArray[np.intp]:
    vertex = np.arange(_ROWS * _COLUMNS).reshape(_ROWS, _COLUMNS)
    corner, right, below, across = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, :-1], vertex[1:, 1:]
    halves = (np.stack([corner, right, across], axis=-1), np.stack([corner, across, below], axis=-1))
    return np.concatenate([half.reshape(-1, 3) for half in halves])
