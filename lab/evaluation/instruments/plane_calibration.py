"""Laser plane from pictures of its line on a checkerboard (article, section 4.5.2 and its reference 65).

The corners give the board's pose in each picture, and so the position of each point of the line in space. The plane is
fitted to the points of all pictures by total least squares with robust weights. One pose of the board gives only one
straight line, so at least two poses are needed, different enough in distance or tilt; the spread of the points across
the line is checked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.calibration.laser_plane import FARTHEST_MM, NEAREST_MM, LaserPlane, LaserPlaneError
from engine.core.frames import BoolArray, FloatArray, frozen
from lab.evaluation.instruments.board import LitBoard

MIN_PICTURES = 2
MIN_SPREAD_MM = 10.0
MAX_RMS_MM = 3.0
OUTLIER_RATIO = 3.0
OUTLIER_MM = 0.5
HUBER_MM = 0.5
_ROUNDS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureResidual:
    """Root mean square distance of one picture's points from the plane [mm]; outliers were not used in the fit."""

    name: str
    points: int
    rms_mm: float
    reprojection_px: float
    is_outlier: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaneCalibration:
    """A fitted plane and its residuals.

    Attributes
    ----------
    spread_mm
        Root mean square extent of all points along and across the plane's longer axis, shape (2,).
    """

    plane: LaserPlane
    pictures: list[PictureResidual]
    spread_mm: FloatArray


def fit_plane(boards: Sequence[tuple[str, LitBoard]], calibration: Calibration) -> PlaneCalibration:
    """Fit the plane.

    Parameters
    ----------
    boards
        Name of each picture, and the line found on its board.

    Raises
    ------
    LaserPlaneError
        There are too few pictures, all points are on one line, or no plane fits.
    """
    names = [name for name, _ in boards]
    if len(boards) < MIN_PICTURES:
        raise LaserPlaneError("pictures", f"{len(boards)} that show the line on the board", f"{MIN_PICTURES} or more")
    clouds = [board.points_mm for _, board in boards]
    is_kept = np.ones(len(boards), dtype=np.bool_)
    normal, distance = _fit(clouds)
    # With two pictures the outlier cannot be identified.
    while is_kept.sum() > MIN_PICTURES:
        rms = _rms(clouds, normal, distance)
        worst = int(np.where(is_kept, rms, -1.0).argmax())
        others = is_kept.copy()
        others[worst] = False
        chosen = [cloud for cloud, is_chosen in zip(clouds, others, strict=True) if is_chosen]
        if not _is_spread(chosen):
            break
        without = _fit(chosen)
        alone = _rms(clouds, *without)
        if alone[worst] < max(OUTLIER_RATIO * float(np.sqrt((alone[others] ** 2).mean())), OUTLIER_MM):
            break
        is_kept, (normal, distance) = others, without
    return _checked(names, boards, is_kept, normal, distance, calibration)


def _checked(
    names: list[str],
    boards: Sequence[tuple[str, LitBoard]],
    is_kept: BoolArray,
    normal: FloatArray,
    distance: float,
    calibration: Calibration,
) -> PlaneCalibration:
    clouds = [board.points_mm for _, board in boards]
    kept = np.concatenate([cloud for cloud, is_chosen in zip(clouds, is_kept, strict=True) if is_chosen])
    spread = _spread(kept)
    if spread[1] < MIN_SPREAD_MM:
        bound = f"{MIN_SPREAD_MM:g} mm or more: hold the board at different distances and tilts"
        raise LaserPlaneError("pictures", f"{spread[1]:.1f} mm apart across the line", bound)
    rms = float(np.sqrt(((kept @ normal - distance) ** 2).mean()))
    if rms > MAX_RMS_MM:
        bound = f"at most {MAX_RMS_MM:g} mm: was the laser or the camera moved between the pictures?"
        raise LaserPlaneError("rms_mm", round(rms, 2), bound)
    if not NEAREST_MM <= distance <= FARTHEST_MM:
        raise LaserPlaneError("distance_mm", round(distance, 2), f"from {NEAREST_MM:g} to {FARTHEST_MM:g}")
    residuals = [
        PictureResidual(
            name=name,
            points=len(board.points_mm),
            rms_mm=float(off),
            reprojection_px=board.reprojection_px,
            is_outlier=not is_chosen,
        )
        for name, (_, board), off, is_chosen in zip(names, boards, _rms(clouds, normal, distance), is_kept, strict=True)
    ]
    plane = LaserPlane(
        camera=calibration.camera,
        normal=normal,
        distance_mm=distance,
        rms_mm=rms,
        pictures=int(is_kept.sum()),
        calibration_sha256=calibration.sha256,
    )
    return PlaneCalibration(plane=plane, pictures=residuals, spread_mm=frozen(spread))


def _fit(clouds: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """Fit a plane with equal weight per picture: unit normal away from the camera, and its distance [mm]."""
    points = np.concatenate(clouds)
    alike = np.concatenate([np.full(len(cloud), 1.0 / len(cloud)) for cloud in clouds])
    weights = alike
    normal, distance = np.array([0.0, 0.0, 1.0]), 0.0
    for _ in range(_ROUNDS):
        middle = (points * weights[:, None]).sum(axis=0) / weights.sum()
        away = (points - middle) * np.sqrt(weights)[:, None]
        normal = np.linalg.svd(away, full_matrices=False)[2][2]
        distance = float(normal @ middle)
        off = np.abs(points @ normal - distance)
        weights = alike * np.minimum(1.0, HUBER_MM / np.maximum(off, 1e-9))
    return (normal, distance) if distance >= 0.0 else (-normal, -distance)


def _rms(clouds: Sequence[FloatArray], normal: FloatArray, distance: float) -> FloatArray:
    """Root mean square distance of each picture's points from the plane [mm], shape (pictures,)."""
    return np.array([np.sqrt(((cloud @ normal - distance) ** 2).mean()) for cloud in clouds])


def _spread(points_mm: FloatArray) -> FloatArray:
    """Root mean square extent along the two longest axes [mm], shape (2,)."""
    away = points_mm - points_mm.mean(axis=0)
    return np.asarray(np.linalg.svd(away, compute_uv=False)[:2] / np.sqrt(len(points_mm)))


def _is_spread(clouds: Sequence[FloatArray]) -> bool:
    return bool(_spread(np.concatenate(clouds))[1] >= MIN_SPREAD_MM)
