"""Both cameras and the pose between them, from pictures of the same board at the same places; outliers left out once.

Three errors per picture: the reprojection error of each camera alone, and the distance of the colour camera's corners
from those predicted by the depth camera and the pose. The last is the error of aligning depth with colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from engine.calibration.procedures.boards import Board
from engine.core.errors import CalibrationError
from engine.core.frames import BoolArray, FloatArray
from engine.core.geometry import Intrinsics, RigidTransform

# k3 is left out: boards rarely reach where it would show, and where none was it bends the picture's rim.
_FLAGS = cv2.CALIB_FIX_K3
FEWEST_PAIRS = 6
LEAST_TURN_DEG = 15.0
LARGEST_FOCAL_SIGMA = 0.005
LARGEST_ANGLE_DEG = 45.0
# A picture is an outlier when its error is this many robust standard deviations above the median, half as much again
# as the median, and more than corners are ever off by.
_OUTLIER_SIGMAS, _OUTLIER_RATIO, _OUTLIER_PX = 4.0, 1.5, 0.2
_SIGMA_OF_MAD = 1.4826


# One camera from many pictures of a board: Zhang's method, as OpenCV does it, with k1 k2 p1 p2.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardPair:
    """Corners of one board in both cameras' pictures, shape (corners, 2) [px]; the order may be either end's first."""

    name: str
    depth_px: FloatArray
    color_px: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairFit:
    """Both cameras and their pose, from the pictures that are not outliers.

    Parameters
    ----------
    pairs
        The pictures used, corners in the same order in both.
    alignment_px
        Corner in the colour picture minus its prediction from the depth camera, shape (pictures, corners, 2).
    outliers
        Names of the pictures left out, each with its reason.
    """

    pairs: tuple[BoardPair, ...]
    depth: CameraFit
    color: CameraFit
    color_from_depth: RigidTransform
    alignment_px: FloatArray
    outliers: dict[str, str]

    @property
    def errors_px(self) -> dict[str, FloatArray]:
        """The three errors a picture."""
        errors = {"depth": self.depth.errors_px, "color": self.color.errors_px}
        return errors | {"alignment": rms_length(self.alignment_px)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSizes:
    """Width and height of both cameras' pictures [px]."""

    depth: tuple[int, int]
    color: tuple[int, int]


def fit_pair(board: Board, pairs: Sequence[BoardPair], sizes: PictureSizes) -> PairFit:
    """Fit each camera alone, leave outliers out, and fit what is left together.

    Raises
    ------
    CalibrationError
        Too few pictures, a board that was hardly ever tilted, or cameras that do not face the same direction.
    """
    _check_enough(board, pairs, sizes)
    first = fit_apart(board, pairs, sizes)
    outliers = find_outliers(first)
    kept = [pair for pair in first.pairs if pair.name not in outliers]
    _check_enough(board, kept, sizes)
    fit = replace(fit_all(board, kept, sizes), outliers=outliers)
    for name, camera in (("depth", fit.depth), ("color", fit.color)):
        share = camera.focal_sigma_px / camera.intrinsics.fx
        if share > LARGEST_FOCAL_SIGMA:
            bound = f"known to {100 * LARGEST_FOCAL_SIGMA:g} %: tilt the board more, and bring it nearer"
            raise CalibrationError(f"{name}.fx", f"known to {100 * share:.1f} %", bound)
    return fit


def fit_apart(board: Board, pairs: Sequence[BoardPair], sizes: PictureSizes) -> PairFit:
    """Fit each camera alone, then the pose between them: a board that moved meanwhile spoils the pose only."""
    depth = fit_camera(board, [pair.depth_px for pair in pairs], sizes.depth)
    color = fit_camera(board, [pair.color_px for pair in pairs], sizes.color)
    matched = [_matched(board, pair, depth.intrinsics, color.intrinsics) for pair in pairs]
    _, _, pose = _stereo(board, matched, depth.intrinsics, color.intrinsics, flags=cv2.CALIB_FIX_INTRINSIC)
    return _explained(board, matched, depth, color, pose)


def fit_together(
    board: Board, fit: PairFit, pairs: Sequence[BoardPair]
) -> tuple[Intrinsics, Intrinsics, RigidTransform]:
    """Fit everything at once, beginning where ``fit`` is: on drawn boards that halves the alignment's error."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    return _stereo(board, pairs, fit.depth.intrinsics, fit.color.intrinsics, flags=flags)


def fit_all(board: Board, pairs: Sequence[BoardPair], sizes: PictureSizes) -> PairFit:
    """Fit pictures of which none is an outlier."""
    apart = fit_apart(board, pairs, sizes)
    depth, color, pose = fit_together(board, apart, apart.pairs)
    cameras = replace(apart.depth, intrinsics=depth), replace(apart.color, intrinsics=color)
    return _explained(board, apart.pairs, *cameras, pose)


def find_outliers(fit: PairFit) -> dict[str, str]:
    """Name the pictures whose errors stand out, with the reason."""
    words = {"depth": "the infrared corners", "color": "the colour corners", "alignment": "the two pictures together"}
    outliers: dict[str, str] = {}
    for kind, errors in fit.errors_px.items():
        for i in np.flatnonzero(_stands_out(errors)):
            name = fit.pairs[i].name
            reason = f"{words[kind]} are {errors[i]:.2f} px off, the median is {np.median(errors):.2f}"
            outliers.setdefault(name, reason)
    return outliers


def _stands_out(errors: FloatArray) -> BoolArray:
    median = np.median(errors)
    spread = _SIGMA_OF_MAD * np.median(np.abs(errors - median))
    bound = max(median + _OUTLIER_SIGMAS * spread, _OUTLIER_RATIO * median, _OUTLIER_PX)
    return np.asarray(errors > bound)


def _check_enough(board: Board, pairs: Sequence[BoardPair], sizes: PictureSizes) -> None:
    if len(pairs) < FEWEST_PAIRS:
        bound = f"at least {FEWEST_PAIRS} pairs in which both cameras see the whole board (15 or more are good)"
        raise CalibrationError("pictures", f"{len(pairs)} pairs", bound)
    turn_deg = largest_turn_deg(board, pairs, sizes)
    if turn_deg < LEAST_TURN_DEG:
        bound = f"boards tilted against each other by {LEAST_TURN_DEG:g} degrees at least (30 to 45 are good)"
        raise CalibrationError("pictures", f"tilted by {turn_deg:.0f} degrees at most", bound)


def largest_turn_deg(board: Board, pairs: Sequence[BoardPair], sizes: PictureSizes) -> float:
    """Return the largest angle between two boards' normals [deg], by an approximate camera."""
    width, height = sizes.depth
    camera = Intrinsics(
        width=width, height=height, fx=0.9 * width, fy=0.9 * width, cx=0.5 * (width - 1), cy=0.5 * (height - 1)
    )
    normals = np.stack([find_pose(board, pair.depth_px, camera).rotation[:, 2] for pair in pairs])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))).max())


def _matched(board: Board, pair: BoardPair, depth: Intrinsics, color: Intrinsics) -> BoardPair:
    """Put the colour corners in the order of the infrared ones: a board turned by half looks the same."""
    from_board = find_pose(board, pair.depth_px, depth)
    angles = []
    for corners in (pair.color_px, pair.color_px[::-1]):
        turn = find_pose(board, corners, color).rotation @ from_board.rotation.T
        angles.append(float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))))
    if min(angles) > LARGEST_ANGLE_DEG:
        bound = f"of cameras that look the same way up, within {LARGEST_ANGLE_DEG:g} degrees"
        raise CalibrationError(f"pictures {pair.name}", f"turned by {min(angles):.0f} degrees", bound)
    if angles[0] <= angles[1]:
        return pair
    return replace(pair, color_px=pair.color_px[::-1].copy())


def _stereo(
    board: Board, pairs: Sequence[BoardPair], depth: Intrinsics, color: Intrinsics, *, flags: int
) -> tuple[Intrinsics, Intrinsics, RigidTransform]:
    _, depth_matrix, depth_lens, color_matrix, color_lens, rotation, translation, *_ = cv2.stereoCalibrate(
        [board.points_mm.astype(np.float32)] * len(pairs),
        [pair.depth_px.astype(np.float32) for pair in pairs],
        [pair.color_px.astype(np.float32) for pair in pairs],
        depth.matrix,
        np.array(depth.distortion),
        color.matrix,
        np.array(color.distortion),
        (depth.width, depth.height),
        flags=flags,
    )
    pose = RigidTransform(rotation=np.asarray(rotation), translation_mm=np.ravel(translation).astype(np.float64))
    cameras = (
        as_intrinsics(depth_matrix, depth_lens, (depth.width, depth.height)),
        as_intrinsics(color_matrix, color_lens, (color.width, color.height)),
    )
    return *cameras, pose


def _explained(
    board: Board, pairs: Sequence[BoardPair], depth: CameraFit, color: CameraFit, pose: RigidTransform
) -> PairFit:
    """Return the errors of a fit for each picture."""
    cameras = depth.intrinsics, color.intrinsics
    return PairFit(
        pairs=tuple(pairs),
        depth=replace(depth, residuals_px=find_residuals(board, [pair.depth_px for pair in pairs], cameras[0])),
        color=replace(color, residuals_px=find_residuals(board, [pair.color_px for pair in pairs], cameras[1])),
        color_from_depth=pose,
        alignment_px=np.stack([_alignment(board, pair, *cameras, pose) for pair in pairs]),
        outliers={},
    )


def _alignment(
    board: Board, pair: BoardPair, depth: Intrinsics, color: Intrinsics, color_from_depth: RigidTransform
) -> FloatArray:
    in_depth = find_pose(board, pair.depth_px, depth).apply(board.points_mm)
    return np.asarray(pair.color_px - color.project(color_from_depth.apply(in_depth)))
