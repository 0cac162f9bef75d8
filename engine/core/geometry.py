"""Cameras and rigid motions, in OpenCV's conventions: pixel centres at integers, x right, y down, z away.

Transforms read right to left: ``color_from_depth`` takes points of the depth camera's frame to the colour camera's.

Least squares of a few terms; the compiled form solves well-conditioned ones, numpy's the rest.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from engine.core.compiled import FramePath
from engine.core.frames import FloatArray, frozen

# Each step leaves a tenth of the error at most, with lenses of this kind.
UNDISTORTION_STEPS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """A pinhole camera with Brown-Conrady distortion (k1, k2, p1, p2, k3); lengths in px.

    ``constants`` are fx, fy, cx, cy, k1, k2, p1, p2 and k3, shape (9,), read-only; ``steps`` those of undistortion.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    constants: FloatArray = field(init=False, repr=False, compare=False)
    steps: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Prepare what every frame needs."""
        constants = np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion], dtype=np.float64)
        object.__setattr__(self, "constants", frozen(constants))
        object.__setattr__(self, "steps", UNDISTORTION_STEPS if any(self.distortion) else 0)

    @property
    def matrix(self) -> FloatArray:
        """The camera matrix, shape (3, 3), float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

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
        compiled = FramePath.kernels
        if compiled is not None:
            rays = np.empty((len(pixels_px), 3))
            compiled.camera_rays(np.ascontiguousarray(pixels_px, dtype=np.float64), self.constants, self.steps, rays)
            return rays
        if not any(self.distortion):
            normalised = (pixels_px - (self.cx, self.cy)) / (self.fx, self.fy)
        else:
            undistorted = cv2.undistortPoints(
                np.ascontiguousarray(pixels_px, dtype=np.float64).reshape(-1, 1, 2),
                self.matrix,
                self.constants[4:].copy(),
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


def least_squares(terms: FloatArray, values: FloatArray) -> FloatArray:
    """Return the weights of some terms, shape (k, n), whose sum is closest to values, shape (n,); shape (k,).

    Of several answers the shortest. NaN raises `numpy.linalg.LinAlgError` or gives NaN, as numpy's does.
    """
    compiled = FramePath.kernels
    if compiled is not None:
        weights = np.empty(len(terms))
        if compiled.least_squares(np.ascontiguousarray(terms), np.ascontiguousarray(values), weights):
            return weights
    return np.asarray(np.linalg.lstsq(terms.T, values, rcond=None)[0])
