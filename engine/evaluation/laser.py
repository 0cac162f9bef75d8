"""Tidegate beside a laser line, the article's ground truth (section 4.5.2, equation 9, Table 2, Figs 12 and 13).

Which point is compared. A point of the ROI grid follows the patient's surface; a laser's line is fixed in space, and on
a chest that rises it slides over the skin, 0.4 to 0.8 mm a millimetre as the laser leans. The article compares *depths
where the line is* in each frame: the laser's from ray and plane, its own from the reconstructed surface at the same
pixel, and takes the difference of each to the reference frame (equation 9). So does this module: the error is exactly
that of equation 9. To be set beside the motion of a grid point p, the laser's motion is carried from the line's place q
to p over Tidegate's own surface, ``D_laser(q) + D_tidegate(p) - D_tidegate(q)``: a bridge of a few millimetres that
changes neither the error nor what it is an error of, but makes both columns the motion of the same point. What the line
itself did (``line_mm``, the article's Fig. 12) is kept beside.

Mind what equation 9 charges: the line reads other skin in inhale than in exhale, so an error of Tidegate's *shape*
between these places counts as an error of its motion. Creases of the shirt that the depth sensor blurs are worth some
tenths of a millimetre there; a laser that leans less slides less.

What is better here than in the article: the line is where red *stands out*, not where it is brightest; points come from
a straight line through some millimetres of it, not from one column; and the laser is read at the depth frame's time,
from a parabola through a quarter of a second of colour pictures, since at 8 mm/s half a frame is 0.13 mm. As in the
article the zero is a single frame, and its noise is part of every error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.calibration import Calibration
from engine.errors import InvalidValueError
from engine.evaluation.agreement import Agreement, agreement
from engine.evaluation.cell_surface import CellSurface
from engine.evaluation.laser_line import DEFAULT_SETTINGS, LineSettings, find_line
from engine.evaluation.time_fit import fit_at
from engine.frames import ROI_COLUMNS, ROI_ROWS, ColorImage, FloatArray, Measurement, RgbdFrame
from engine.laser_plane import LaserPlane
from engine.stages.regions import check_points
from engine.stages.roi import color_from_roi

CELL_PX = 5
"""Cells that the pipeline should report for this; larger ones blur the shirt's creases."""
FIVE_SHARES = (0.15, 0.325, 0.5, 0.675, 0.85)
"""Where the five points are by default, as shares of the way along the line through the ROI."""
MAX_AWAY = 40.0
"""How far from a grid point the line may be, in grid points; some 45 mm."""
TYPICAL_DEPTH_MM = 850.0
MAX_MM_A_PX = 12.0
MIN_LEAN = 0.1
_AVERAGE_SIGMA = 4.0
_LEAST_POINTS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserComparison:
    """Both motions of each point in each frame [mm], positive towards the camera; NaN where not measured.

    Attributes
    ----------
    frame_index, timestamp_us
        Of every depth frame of the recording, shape (n,).
    points_rc
        Grid points (row, column), shape (p, 2); NaN for one that the line never came near.
    laser_mm, tidegate_mm
        Motion of the grid points, shape (n, p). The laser's zero is the first frame that both measured; there it is
        given Tidegate's value, which is zero if that frame is Tidegate's reference.
    line_mm
        Motion of the line itself, wherever on the skin it lies (article, Fig. 12), shape (n, p).
    place_rc
        Where on the grid the line was, (row, column), shape (n, p, 2).
    offset_mm
        How much deeper the laser has the skin than Tidegate, median; NaN without a reading. Some mm are the depth
        sensor's scale. Some cm mean that this is not the laser's plane.
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
        """Compare point by point."""
        return [agreement(laser, ours) for laser, ours in zip(self.laser_mm.T, self.tidegate_mm.T, strict=True)]


class LaserGauge:
    """Looks on while a pipeline measures, and reads the laser's line off the same frames.

    Parameters
    ----------
    points
        Grid points (row, column) to compare at; none for places along the line, wherever it first lies.
    shares
        Those places, as shares of the way through the ROI; ignored with ``points``.
    cell_px
        The cells that the pipeline reports.

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
        self._asked = np.array(points, dtype=np.float64).reshape(-1, 2)
        self._shares = np.array(shares, dtype=np.float64)
        self._is_across: bool | None = None
        count = len(points) or len(shares)
        self._points_rc = self._asked if len(points) else np.full((count, 2), np.nan)
        self._surface = CellSurface(cell_px)
        self._color_us: list[int] = []
        self._lines: list[FloatArray] = []
        self._frames: list[tuple[int, int]] = []
        self._readings: list[_Reading] = []
        _check_lean(plane, calibration)

    def add(self, frame: RgbdFrame, measurement: Measurement) -> None:
        """Take one frame and what Tidegate made of it, in order; training frames too."""
        if not self._color_us or frame.color_timestamp_us > self._color_us[-1]:
            self._color_us.append(frame.color_timestamp_us)
            self._lines.append(self._read_line(frame.color, measurement))
        self._frames.append((measurement.frame_index, measurement.timestamp_us))
        self._readings.append(self._read_surface(measurement, self._lines[-1][:, :2]))

    def comparison(self) -> LaserComparison:
        """Set both instruments beside each other."""
        index, timestamp_us = np.array(self._frames, dtype=np.int64).reshape(-1, 2).T
        lines = np.array(self._lines).reshape(-1, len(self._points_rc), 3)
        lines = fit_at(np.array(self._color_us, dtype=np.int64), lines, timestamp_us)
        place_rc, line_depth = lines[..., :2], lines[..., 2]
        motion, here, bridge = self._bridge(place_rc)
        bridge[np.linalg.norm(place_rc - self._points_rc, axis=-1) > MAX_AWAY] = np.nan
        return LaserComparison(
            frame_index=index,
            timestamp_us=timestamp_us,
            points_rc=self._points_rc.copy(),
            laser_mm=_from_zero(line_depth + bridge, motion),
            tidegate_mm=motion,
            line_mm=_from_zero(line_depth, motion),
            place_rc=place_rc,
            offset_mm=_median(line_depth + bridge - here),
        )

    def _bridge(self, place_rc: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return Tidegate's motion and depth of the points, and how much deeper they are than the line's places."""
        shape = place_rc.shape[:2]
        motion, here, there = (
            np.array([getattr(reading, name) for reading in self._readings]).reshape(shape)
            for name in ("motion_mm", "here_mm", "there_mm")
        )
        slope = np.array([reading.slope for reading in self._readings]).reshape(*shape, 2)
        read_at = np.array([reading.place_rc for reading in self._readings]).reshape(*shape, 2)
        return motion, here, here - there - (slope * (place_rc - read_at)).sum(axis=-1)

    def _read_line(self, color: ColorImage, measurement: Measurement) -> FloatArray:
        """Read the line beside each point: (row, column) on the grid and depth [mm], shape (p, 3); NaN where not."""
        nothing = np.full((len(self._points_rc), 3), np.nan)
        if measurement.markers is None:
            return nothing
        centers_px = measurement.markers.centers_px
        region = np.zeros(color.shape[:2], dtype=np.uint8)
        cv2.fillConvexPoly(region, np.rint(centers_px).astype(np.int32), 1)
        line = find_line(color, region.astype(np.bool_), is_upright=self._is_upright, settings=self._settings)
        if len(line.pixels_px) < _LEAST_POINTS:
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
        """Where along the line the points are: columns of the grid if it runs across, else rows."""
        axis, length = (1, ROI_COLUMNS) if self._is_across else (0, ROI_ROWS)
        return self._asked[:, axis] if len(self._asked) else self._shares * (length - 1.0)

    def _read_surface(self, measurement: Measurement, place_rc: FloatArray) -> "_Reading":
        """Read Tidegate's surface where the line is and at the points."""
        nothing = np.full(len(place_rc), np.nan)
        motion = measurement.motion
        if motion is None:
            return _Reading(
                place_rc=place_rc, there_mm=nothing, slope=place_rc * np.nan, here_mm=nothing, motion_mm=nothing
            )
        there, *slopes = self._surface.values(motion.regions_depth_mm, place_rc)
        # Without a point asked for, it is where the line lies first.
        is_new = np.isnan(self._points_rc[:, 0]) & np.isfinite(there)
        self._points_rc[is_new] = np.rint(place_rc[is_new])
        return _Reading(
            place_rc=place_rc,
            there_mm=there,
            slope=np.column_stack(slopes),
            here_mm=self._surface.values(motion.regions_depth_mm, self._points_rc)[0],
            motion_mm=self._surface.values(motion.regions_mm, self._points_rc)[0],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Reading:
    """Tidegate's surface in one frame: at the line's places with its slope there, and at the points."""

    place_rc: FloatArray
    there_mm: FloatArray
    slope: FloatArray
    here_mm: FloatArray
    motion_mm: FloatArray


def _check_lean(plane: LaserPlane, calibration: Calibration) -> None:
    """Refuse a laser beside the camera's own view: its line would hardly move when the chest does."""
    camera = calibration.color
    lean = max(abs(plane.normal[0]) / camera.fx, abs(plane.normal[1]) / camera.fy)
    mm_a_px = TYPICAL_DEPTH_MM**2 * lean / plane.distance_mm
    if not mm_a_px <= MAX_MM_A_PX:
        raise InvalidValueError(
            "plane", f"{mm_a_px:.0f} mm of depth a pixel at {TYPICAL_DEPTH_MM:.0f} mm", f"at most {MAX_MM_A_PX:g}"
        )
    mm_seen = lean * camera.fx
    if mm_seen < MIN_LEAN:
        raise InvalidValueError("normal", plane.normal.tolist(), f"across the view by {MIN_LEAN:g} or more in x or y")


def _average(line: FloatArray, along: FloatArray, axis: int) -> FloatArray:
    """Lay a straight line through the neighbourhood of each place along a laser's line.

    Parameters
    ----------
    line
        Points of it: row, column, depth; shape (n, 3).
    along
        Wanted values of column ``axis`` of it, shape (p,).

    Returns
    -------
    FloatArray
        Row, column, depth there, shape (p, 3); NaN where there is too little of the line on both sides.
    """
    away = line[:, axis] - along[:, None]
    weight = np.where(np.abs(away) < 3.0 * _AVERAGE_SIGMA, np.exp(-0.5 * (away / _AVERAGE_SIGMA) ** 2), 0.0)
    total, first, second = (np.asarray((weight * away**power).sum(axis=1)) for power in (0, 1, 2))
    determinant = total * second - first**2
    is_held = ((weight > 0.1).sum(axis=1) >= _LEAST_POINTS) & (np.abs(first) < _AVERAGE_SIGMA * total)
    share = (second[:, None] - first[:, None] * away) * weight / np.where(is_held, determinant, 1.0)[:, None]
    values = share @ line
    values[:, axis] = along
    return np.where(is_held[:, None], values, np.nan)


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _from_zero(depth_mm: FloatArray, motion_mm: FloatArray) -> FloatArray:
    """Turn depths, shape (n, p), to motion whose zero is such that it starts with the other's first value."""
    is_both = np.isfinite(depth_mm) & np.isfinite(motion_mm)
    if len(is_both) == 0:
        return depth_mm
    first, points = is_both.argmax(axis=0), np.arange(depth_mm.shape[1])
    zero = np.where(is_both.any(axis=0), depth_mm[first, points] + motion_mm[first, points], np.nan)
    return np.asarray(zero - depth_mm)
