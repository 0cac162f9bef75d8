"""How far a still surface of known shape is from what a camera reads of it: a plane, or a cylinder such as a drum.

A plane shows errors that differ from place to place, a cylinder those that differ with the distance: both are fitted to
the mean of many pictures, in the camera's own space.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from engine.core.frames import FloatArray

SQUARE_PX = 8
LEAST_POINTS = 100
ENDS_PERCENT = 2.0
FLANK_SHARE = 0.4
"""Points deeper than this share of the radius below the drum's top lie on its sides, steeper than 53 degrees."""


class SurfaceFit(NamedTuple):
    """A fitted surface: root mean square of what is left [mm], and the cylinder's radius [mm], infinite for a plane."""

    rest_mm: float
    radius_mm: float


def points_mm(mean_mm: FloatArray, rays: FloatArray) -> FloatArray:
    """Return the points of whole squares of `SQUARE_PX` in the camera's space [mm], shape (n, 3).

    Parameters
    ----------
    mean_mm
        Mean depth, NaN where there is none, shape (rows, columns).
    rays
        Directions of these pixels with a depth of 1, shape (rows, columns, 3).
    """
    rows, columns = (size // SQUARE_PX for size in mean_mm.shape)
    points = (mean_mm[..., None] * rays)[: rows * SQUARE_PX, : columns * SQUARE_PX]
    squares = points.reshape(rows, SQUARE_PX, columns, SQUARE_PX, 3).mean(axis=(1, 3)).reshape(-1, 3)
    return np.asarray(squares[np.isfinite(squares).all(axis=1)])


def fit_plane(points: FloatArray) -> SurfaceFit | None:
    """Fit a plane; None with too few points."""
    if len(points) < LEAST_POINTS:
        return None
    offsets = points - points.mean(axis=0)
    normal = np.linalg.svd(offsets, full_matrices=False)[2][2]
    return SurfaceFit(rest_mm=_rms(offsets @ normal), radius_mm=float("inf"))


def fit_cylinder(points: FloatArray, near_mm: float) -> SurfaceFit | None:
    """Fit a cylinder of about ``near_mm`` radius that lies across the view, its axis behind the surface.

    Returns None with too few points. Its steep sides and what lies behind it do not count. The fit begins with the axis
    along the picture's rows and its columns.
    """
    if len(points) < LEAST_POINTS:
        return None
    top_mm = float(np.percentile(points[:, 2], ENDS_PERCENT))
    points = points[points[:, 2] < top_mm + FLANK_SHARE * near_mm]
    if len(points) < LEAST_POINTS:
        return None
    middle = np.median(points, axis=0)
    found = []
    for along in (0, 1):
        across = 1 - along

        def rest_mm(values: FloatArray, along: int = along, across: int = across) -> FloatArray:
            """Distance of each point from a cylinder: axis offset across and behind, its two slopes, the radius."""
            offset, behind, slope_across, slope_depth, radius = values
            direction = np.zeros(3)
            direction[along], direction[across], direction[2] = 1.0, slope_across, slope_depth
            direction /= np.linalg.norm(direction)
            origin = np.zeros(3)
            origin[along], origin[across], origin[2] = middle[along], offset, behind
            away = points - origin
            away = away - (away @ direction)[:, None] * direction
            return np.asarray(np.linalg.norm(away, axis=1) - radius)

        start = [float(middle[across]), top_mm + near_mm, 0.0, 0.0, near_mm]
        answer = least_squares(rest_mm, start, loss="soft_l1", x_scale=[1.0, 1.0, 0.01, 0.01, 1.0])
        found.append(SurfaceFit(rest_mm=_rms(rest_mm(answer.x)), radius_mm=float(answer.x[4])))
    return min(found, key=lambda one: one.rest_mm)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
