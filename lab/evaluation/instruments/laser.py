"""Comparison with a laser line, the article's ground truth (section 4.5.2, equation 9, Table 2, Figs 12 and 13).

Compared points. A point of the ROI grid follows the patient's surface, but the laser line is fixed in space: on a
rising chest it slides over the skin by 0.4 to 0.8 mm per mm, depending on the laser's inclination. The article compares
the *depths at the line* in each frame, the laser's from ray and plane, its own from the reconstructed surface at the
same pixel, and takes the difference of each to the reference frame (equation 9). This module computes the same error.
For comparison with the motion of a grid point p, the laser's motion is transferred from the line's position q to p over
Tidegate's surface, ``D_laser(q) + D_tidegate(p) - D_tidegate(q)``: an offset over a few millimetres that leaves the
error unchanged and makes both columns the motion of the same point. The motion of the line itself (``line_mm``, the
article's Fig. 12) is given as well.

A limit of equation 9: the line is on different skin in inhale and in exhale, so an error of Tidegate's *shape* between
these positions counts as an error of its motion. Creases of the shirt, blurred by the depth sensor, contribute some
tenths of a millimetre; a less inclined laser slides less.

Improvements on the article: the line is where red exceeds the other colours, not where it is brightest; points come
from a straight line fitted to some millimetres of it, not from one column; and the laser is interpolated to the depth
frame's time by a parabola through a quarter of a second of colour pictures, since at 8 mm/s half a frame period is
0.13 mm. As in the article, the reference is a single frame, whose noise is part of every error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.calibration.camera_calibration import Calibration
from engine.calibration.laser_plane import LaserPlane
from engine.core.errors import InvalidValueError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, ColorImage, FloatArray, Measurement, RgbdFrame
from engine.motion.stages.regions import check_points
from engine.motion.stages.roi import color_from_roi
from lab.evaluation.instruments.agreement import Agreement, agreement, fit_at
from lab.evaluation.instruments.laser_line import DEFAULT_SETTINGS, CellSurface, LineSettings, find_line

CELL_PX = 5
"""Size of the pipeline's cells for this comparison [px]; larger ones blur the shirt's creases."""
FIVE_SHARES = (0.15, 0.325, 0.5, 0.675, 0.85)
"""Default positions of the five points, as shares of the line's length in the ROI."""
MAX_DISTANCE = 40.0
"""Largest distance of the line from a grid point, in grid points; about 45 mm."""
TYPICAL_DEPTH_MM = 850.0
MAX_MM_PER_PX = 12.0
MIN_LEAN = 0.1
_AVERAGE_SIGMA = 4.0
_MIN_POINTS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserComparison:
    """Both motions of each point in each frame [mm], positive towards the camera; NaN where not measured.

    Attributes
    ----------
    frame_index, timestamp_us
        Index and device time of every depth frame, shape (n,).
    points_rc
        Grid points (row, column), shape (p, 2); NaN for a point that the line never came near.
    laser_mm, tidegate_mm
        Motion of the grid points, shape (n, p). The laser's motion is set equal to Tidegate's in the first frame that
        both measured; that is offset_mm_ if the frame is Tidegate's reference.
    line_mm
        Motion of the line itself, wherever it is on the skin (article, Fig. 12), shape (n, p).
    place_rc
        Position of the line on the grid (row, column), shape (n, p, 2).
    offset_mm
        Median depth of the laser less Tidegate's; NaN without a reading. Some mm are due to the depth sensor's scale;
        some cm mean that the plane is not this laser's.
    """

    frame_index: npt.NDArray[np.int64]
    timestamp_us: npt.NDArray[np.int64]
    points_rc: FloatArray
    laser_mm: FloatArray
    tidegate_mm: FloatArray
    line_mm: FloatArray
    place_rc: FloatArray
    offset_mm: float

    def agreements(self) -> list[Agreement]:
        """Return the agreement at each point."""
        return [agreement(laser, ours) for laser, ours in zip(self.laser_mm.T, self.tidegate_mm.T, strict=True)]


class LaserGauge:
    """Measures the laser line in the frames that a pipeline measures.

    Parameters
    ----------
    points
        Grid points (row, column) to compare at; empty for points along the line's first position.
    shares
        Positions of those points, as shares of the line's length in the ROI; ignored with ``points``.
    cell_px
        Size of the pipeline's cells [px].

    Raises
    ------
    InvalidValueError
        A point is off the grid.
    """

    def __init__(
        self,
        calibration: Calibration,
        plane: LaserPlane,
        *,
        points: Sequence[tuple[int, int]] = (),
        shares: Sequence[float] = FIVE_SHARES,
        cell_px: int = CELL_PX,
        settings: LineSettings = DEFAULT_SETTINGS,
    ) -> None:
        check_points(list(points))
        self._calibration, self._plane, self._settings = calibration, plane, settings
        self._is_upright = bool(abs(plane.normal[0]) > abs(plane.normal[1]))
        self._given_rc = np.array(points, dtype=np.float64).reshape(-1, 2)
        self._shares = np.array(shares, dtype=np.float64)
        self._is_across: bool | None = None
        count = len(points) or len(shares)
        self._points_rc = self._given_rc if len(points) else np.full((count, 2), np.nan)
        self._surface = CellSurface(cell_px)
        self._color_us: list[int] = []
        self._lines: list[FloatArray] = []
        self._frames: list[tuple[int, int]] = []
        self._readings: list[_Reading] = []
        _check_lean(plane, calibration)

    def add(self, frame: RgbdFrame, measurement: Measurement) -> None:
        """Add one frame and Tidegate's measurement of it, in order, training frames included."""
        if not self._color_us or frame.color_timestamp_us > self._color_us[-1]:
            self._color_us.append(frame.color_timestamp_us)
            self._lines.append(self._read_line(frame.color, measurement))
        self._frames.append((measurement.frame_index, measurement.timestamp_us))
        self._readings.append(self._read_surface(measurement, self._lines[-1][:, :2]))

    def comparison(self) -> LaserComparison:
        """Return both instruments' motion of all frames added so far."""
        index, timestamp_us = np.array(self._frames, dtype=np.int64).reshape(-1, 2).T
        lines = np.array(self._lines).reshape(-1, len(self._points_rc), 3)
        lines = fit_at(np.array(self._color_us, dtype=np.int64), lines, timestamp_us)
        place_rc, line_depth = lines[..., :2], lines[..., 2]
        motion, point_depth, bridge = self._bridge(place_rc)
        bridge[np.linalg.norm(place_rc - self._points_rc, axis=-1) > MAX_DISTANCE] = np.nan
        return LaserComparison(
            frame_index=index,
            timestamp_us=timestamp_us,
            points_rc=self._points_rc.copy(),
            laser_mm=_motion_from(line_depth + bridge, motion),
            tidegate_mm=motion,
            line_mm=_motion_from(line_depth, motion),
            place_rc=place_rc,
            offset_mm=_median(line_depth + bridge - point_depth),
        )

    def _bridge(self, place_rc: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return Tidegate's motion and depth at the points [mm], and their depth less that at the line's positions."""
        shape = place_rc.shape[:2]
        motion, point_depth, line_surface = (
            np.array([getattr(reading, name) for reading in self._readings]).reshape(shape)
            for name in ("motion_mm", "point_depth_mm", "line_depth_mm")
        )
        slope = np.array([reading.slope for reading in self._readings]).reshape(*shape, 2)
        read_at = np.array([reading.place_rc for reading in self._readings]).reshape(*shape, 2)
        return motion, point_depth, point_depth - line_surface - (slope * (place_rc - read_at)).sum(axis=-1)

    def _read_line(self, color: ColorImage, measurement: Measurement) -> FloatArray:
        """Measure the line near each point: (row, column) on the grid and depth [mm], shape (p, 3); NaN where none."""
        nothing = np.full((len(self._points_rc), 3), np.nan)
        if measurement.markers is None:
            return nothing
        centers_px = measurement.markers.centers_px
        region = np.zeros(color.shape[:2], dtype=np.uint8)
        cv2.fillConvexPoly(region, np.rint(centers_px).astype(np.int32), 1)
        line = find_line(color, region.astype(np.bool_), is_upright=self._is_upright, settings=self._settings)
        if len(line.pixels_px) < _MIN_POINTS:
            return nothing
        points_mm = self._plane.meet(self._calibration.color.rays(line.pixels_px))
        depth_mm = self._calibration.color_from_depth.inverse.apply(points_mm)[:, 2]
        places_rc = cv2.perspectiveTransform(line.pixels_px[None], np.linalg.inv(color_from_roi(centers_px)))[
            0, :, ::-1
        ]
        if self._is_across is None:
            rows, columns = np.ptp(places_rc, axis=0)
            self._is_across = bool(columns >= rows)
        return _average(np.column_stack([places_rc, depth_mm]), self._along(), 1 if self._is_across else 0)

    def _along(self) -> FloatArray:
        """Positions of the points along the line: columns of the grid if it runs across, otherwise rows."""
        axis, length = (1, ROI_COLUMNS) if self._is_across else (0, ROI_ROWS)
        return self._given_rc[:, axis] if len(self._given_rc) else self._shares * (length - 1.0)

    def _read_surface(self, measurement: Measurement, place_rc: FloatArray) -> "_Reading":
        """Interpolate Tidegate's surface at the line's positions and at the points."""
        nothing = np.full(len(place_rc), np.nan)
        motion = measurement.motion
        if motion is None:
            return _Reading(
                place_rc=place_rc,
                line_depth_mm=nothing,
                slope=place_rc * np.nan,
                point_depth_mm=nothing,
                motion_mm=nothing,
            )
        line_surface, *slopes = self._surface.values(motion.regions_depth_mm, place_rc)
        # Without given points, a point is at the line's first position.
        is_new = np.isnan(self._points_rc[:, 0]) & np.isfinite(line_surface)
        self._points_rc[is_new] = np.rint(place_rc[is_new])
        return _Reading(
            place_rc=place_rc,
            line_depth_mm=line_surface,
            slope=np.column_stack(slopes),
            point_depth_mm=self._surface.values(motion.regions_depth_mm, self._points_rc)[0],
            motion_mm=self._surface.values(motion.regions_mm, self._points_rc)[0],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Reading:
    """Tidegate's surface in one frame: depth and slope at the line's positions, depth and motion at the points."""

    place_rc: FloatArray
    line_depth_mm: FloatArray
    slope: FloatArray
    point_depth_mm: FloatArray
    motion_mm: FloatArray


def _check_lean(plane: LaserPlane, calibration: Calibration) -> None:
    """Raise InvalidValueError if the laser is nearly parallel to the camera's rays: its line would hardly move."""
    camera = calibration.color
    lean = max(abs(plane.normal[0]) / camera.fx, abs(plane.normal[1]) / camera.fy)
    mm_per_px = TYPICAL_DEPTH_MM**2 * lean / plane.distance_mm
    if not mm_per_px <= MAX_MM_PER_PX:
        raise InvalidValueError(
            "plane", f"{mm_per_px:.0f} mm of depth a pixel at {TYPICAL_DEPTH_MM:.0f} mm", f"at most {MAX_MM_PER_PX:g}"
        )
    x_or_y_slope = lean * camera.fx
    if x_or_y_slope < MIN_LEAN:
        raise InvalidValueError("normal", plane.normal.tolist(), f"across the view by {MIN_LEAN:g} or more in x or y")


def _average(line: FloatArray, along: FloatArray, axis: int) -> FloatArray:
    """Fit a straight line to the neighbourhood of each position along a laser line.

    Parameters
    ----------
    line
        Points of the line: row, column, depth [mm]; shape (n, 3).
    along
        Positions in column ``axis`` of ``line``, shape (p,).

    Returns
    -------
    FloatArray
        Row, column, depth line_surface, shape (p, 3); NaN where line_surface are too few points on both sides.
    """
    away = line[:, axis] - along[:, None]
    weight = np.where(np.abs(away) < 3.0 * _AVERAGE_SIGMA, np.exp(-0.5 * (away / _AVERAGE_SIGMA) ** 2), 0.0)
    total, first, second = (np.asarray((weight * away**power).sum(axis=1)) for power in (0, 1, 2))
    determinant = total * second - first**2
    is_held = ((weight > 0.1).sum(axis=1) >= _MIN_POINTS) & (np.abs(first) < _AVERAGE_SIGMA * total)
    share = (second[:, None] - first[:, None] * away) * weight / np.where(is_held, determinant, 1.0)[:, None]
    values = share @ line
    values[:, axis] = along
    return np.where(is_held[:, None], values, np.nan)


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _motion_from(depth_mm: FloatArray, motion_mm: FloatArray) -> FloatArray:
    """Convert depths, shape (n, p), to motion with the offset that makes its first value equal to the other's."""
    is_both = np.isfinite(depth_mm) & np.isfinite(motion_mm)
    if len(is_both) == 0:
        return depth_mm
    first, points = is_both.argmax(axis=0), np.arange(depth_mm.shape[1])
    offset_mm_ = np.where(is_both.any(axis=0), depth_mm[first, points] + motion_mm[first, points], np.nan)
    return np.asarray(offset_mm_ - depth_mm)
