"""Cameras and rigid motions, in OpenCV's conventions: pixel centres at integers, x right, y down, z away.

Transforms read right to left: ``color_from_depth`` takes points of the depth camera's frame to the colour camera's.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from engine.core.compiled import kernels
from engine.core.frames import FloatArray, frozen

# Each step leaves a tenth of the error at most, with lenses of this kind.
UNDISTORTION_STEPS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """A pinhole camera with Brown-Conrady distortion (k1, k2, p1, p2, k3); lengths in px."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> FloatArray:
        """The camera matrix, shape (3, 3), float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def constants(self) -> FloatArray:
        """fx, fy, cx, cy, k1, k2, p1, p2 and k3, shape (9,), read-only."""
        return _prepared(self)[1]

    def rays(self, pixels_px: FloatArray) -> FloatArray:
        """Undistort pixels to rays of unit depth.

        Parameters
        ----------
        pixels_px
            Pixel coordinates (x, y) [px], shape (N, 2).

        Returns
        -------
        FloatArray
            (x/z, y/z, 1), shape (N, 3), float64.
        """
        compiled = kernels()
        if compiled is not None:
            rays = np.empty((len(pixels_px), 3))
            _, constants, steps = _prepared(self)
            compiled.camera_rays(np.ascontiguousarray(pixels_px, dtype=np.float64), constants, steps, rays)
            return rays
        if not any(self.distortion):
            normalised = (pixels_px - (self.cx, self.cy)) / (self.fx, self.fy)
        else:
            undistorted = cv2.undistortPoints(
                np.ascontiguousarray(pixels_px, dtype=np.float64).reshape(-1, 1, 2),
                *_prepared(self)[0],
                criteria=(cv2.TERM_CRITERIA_COUNT, UNDISTORTION_STEPS, 0.0),
            )
            normalised = np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)
        return np.column_stack([normalised, np.ones(len(normalised))])

    def project(self, points_mm: FloatArray) -> FloatArray:
        """Project points of this camera's frame [mm], shape (N, 3), to pixels (x, y) [px], shape (N, 2)."""
        x = points_mm[:, 0] / points_mm[:, 2]
        y = points_mm[:, 1] / points_mm[:, 2]
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x_distorted = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        y_distorted = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.column_stack([self.fx * x_distorted + self.cx, self.fy * y_distorted + self.cy])


@lru_cache(maxsize=16)
def _prepared(camera: Intrinsics) -> tuple[tuple[FloatArray, FloatArray], FloatArray, int]:
    """Return what every frame needs: matrix and distortion, all constants in a row, and the steps of undistortion."""
    constants = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])
    steps = UNDISTORTION_STEPS if any(camera.distortion) else 0
    return (frozen(camera.matrix), frozen(constants[4:].copy())), frozen(constants), steps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigidTransform:
    """``y = rotation @ x + translation_mm``; shapes (3, 3) and (3,), float64."""

    rotation: FloatArray
    translation_mm: FloatArray

    def __post_init__(self) -> None:
        """Make both arrays read-only."""
        frozen(self.rotation)
        frozen(self.translation_mm)

    def apply(self, points_mm: FloatArray) -> FloatArray:
        """Move points, shape (N, 3) [mm]."""
        return points_mm @ self.rotation.T + self.translation_mm

    @property
    def inverse(self) -> "RigidTransform":
        """The motion back."""
        return RigidTransform(rotation=self.rotation.T.copy(), translation_mm=-self.rotation.T @ self.translation_mm)
