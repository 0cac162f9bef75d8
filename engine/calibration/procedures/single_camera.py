"""One camera from many pictures of a board: Zhang's method, as OpenCV does it, with k1 k2 p1 p2."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.calibration.procedures.boards import Board
from engine.core.frames import FloatArray
from engine.core.geometry import Intrinsics, RigidTransform

# k3 is left out: boards rarely reach where it would show, and where none was it bends the picture's rim.
_FLAGS = cv2.CALIB_FIX_K3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraFit:
    """One camera as fitted.

    Parameters
    ----------
    intrinsics
        The camera.
    residuals_px
        Corner seen less corner predicted, shape (pictures, corners, 2) [px].
    focal_sigma_px
        Standard deviation of the focal length, of fx and fy the larger.
    """

    intrinsics: Intrinsics
    residuals_px: FloatArray
    focal_sigma_px: float

    @property
    def errors_px(self) -> FloatArray:
        """Root mean square of the residuals' length, a picture; shape (pictures,)."""
        return rms_length(self.residuals_px)


def fit_camera(board: Board, corners_px: Sequence[FloatArray], size_px: tuple[int, int]) -> CameraFit:
    """Fit one camera; ``corners_px`` holds (corners, 2) a picture."""
    points = board.points_mm
    objects = [points.astype(np.float32)] * len(corners_px)
    images = [corners.astype(np.float32) for corners in corners_px]
    _, matrix, coefficients, turns, shifts, sigmas, *_ = cv2.calibrateCameraExtended(
        objects, images, size_px, np.eye(3), np.zeros(5), flags=_FLAGS
    )
    intrinsics = as_intrinsics(matrix, coefficients, size_px)
    seen = [intrinsics.project(pose_of(turn, shift).apply(points)) for turn, shift in zip(turns, shifts, strict=True)]
    return CameraFit(
        intrinsics=intrinsics,
        residuals_px=np.stack(list(corners_px)) - np.stack(seen),
        focal_sigma_px=float(np.max(np.ravel(sigmas)[:2])),
    )


def as_intrinsics(matrix: npt.ArrayLike, coefficients: npt.ArrayLike, size_px: tuple[int, int]) -> Intrinsics:
    """Take a camera in OpenCV's form."""
    k1, k2, p1, p2, k3 = (float(value) for value in np.ravel(coefficients)[:5])
    matrix = np.asarray(matrix, dtype=np.float64)
    return Intrinsics(
        width=size_px[0],
        height=size_px[1],
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]),
        distortion=(k1, k2, p1, p2, k3),
    )


def find_residuals(board: Board, corners_px: Sequence[FloatArray], camera: Intrinsics) -> FloatArray:
    """Corner seen less corner predicted, with the board where this camera alone puts it; (pictures, corners, 2)."""
    points = board.points_mm
    return np.stack([seen - camera.project(find_pose(board, seen, camera).apply(points)) for seen in corners_px])


def find_pose(board: Board, corners_px: FloatArray, camera: Intrinsics) -> RigidTransform:
    """Find where the board stands before a known camera."""
    _, turn, shift = cv2.solvePnP(
        board.points_mm, corners_px, camera.matrix, np.array(camera.distortion), flags=cv2.SOLVEPNP_ITERATIVE
    )
    return pose_of(turn, shift)


def pose_of(turn: npt.ArrayLike, shift_mm: npt.ArrayLike) -> RigidTransform:
    """Take a pose in OpenCV's form, a rotation vector and a translation."""
    rotation, _ = cv2.Rodrigues(np.asarray(turn, dtype=np.float64))
    return RigidTransform(rotation=np.asarray(rotation), translation_mm=np.ravel(shift_mm).astype(np.float64))


def rms_length(vectors: FloatArray) -> FloatArray:
    """Root mean square length of vectors (..., n, 2), over n."""
    return np.asarray(np.sqrt(np.square(vectors).sum(axis=-1).mean(axis=-1)))
