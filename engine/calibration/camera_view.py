"""Measure how the camera looks at the patient, about once a second, while the gate is disarmed."""

import math

import numpy as np

from engine.core.frames import DepthImage, FloatArray, RgbdFrame
from engine.core.geometry import Intrinsics
from engine.core.position_check import CameraAdvice, CameraView
from engine.core.warmth import Warmth

PERIOD_NS = 1_000_000_000
STEP_PX = 8
"""One pixel in 64 is read: 1,200 of a VGA picture's middle."""
MIN_READINGS = 50
NEAREST_MM, FARTHEST_MM = 600.0, 1200.0
"""Nearer, an inhalation approaches the blind range of structured-light cameras; farther, a depth step exceeds 4 mm."""
MAX_TILT_DEG = 15.0
MIN_COVERAGE = 0.9
DARKEST, BRIGHTEST, MAX_SATURATED = 0.1, 0.85, 0.05
_CHANNEL_LIMIT = 250
_TRIMMED_SHARE = 0.75


class CameraViewMeter:
    """Describes frames of one camera, whose warmth another part follows; for the engine's thread."""

    def __init__(self, depth: Intrinsics, warmth: Warmth) -> None:
        self._depth, self._warmth = depth, warmth
        self._first_ns: int | None = None
        self._next_ns = 0
        self._newest: CameraView | None = None

    def look(self, frame: RgbdFrame) -> CameraView:
        """Return the newest description; made from this frame if the last one is a second old."""
        if self._first_ns is None:
            self._first_ns = frame.received_ns
        if self._newest is None or frame.received_ns >= self._next_ns:
            self._next_ns = frame.received_ns + PERIOD_NS
            self._newest = camera_view(
                frame,
                self._depth,
                running_s=(frame.received_ns - self._first_ns) / 1e9,
                warm_in_s=self._warmth.left_s,
            )
        return self._newest


def camera_view(frame: RgbdFrame, depth: Intrinsics, *, running_s: float, warm_in_s: float) -> CameraView:
    """Describe the middle of a frame; the camera is warm in ``warm_in_s``, 0 for a recording [s]."""
    points_mm, coverage = _points(frame.depth_mm, depth)
    distance_mm = float(np.median(points_mm[:, 2])) if len(points_mm) else math.nan
    color = frame.color[_middle(frame.color.shape)]
    brightness, saturated = float(color.mean() / 255.0), float((color.max(axis=2) >= _CHANNEL_LIMIT).mean())
    tilt_deg = _tilt_deg(points_mm)
    found = {
        CameraAdvice.TOO_NEAR: distance_mm < NEAREST_MM,
        CameraAdvice.TOO_FAR: distance_mm > FARTHEST_MM,
        CameraAdvice.TILTED: tilt_deg > MAX_TILT_DEG,
        CameraAdvice.GAPS: coverage < MIN_COVERAGE,
        CameraAdvice.TOO_DARK: brightness < DARKEST,
        CameraAdvice.TOO_BRIGHT: brightness > BRIGHTEST or saturated > MAX_SATURATED,
        CameraAdvice.WARMING_UP: warm_in_s > 0.0,
    }
    return CameraView(
        distance_mm=distance_mm,
        tilt_deg=tilt_deg,
        coverage=coverage,
        brightness=brightness,
        saturated=saturated,
        running_s=running_s,
        warm_in_s=warm_in_s,
        advice=tuple(advice for advice, is_so in found.items() if is_so),
    )


def _middle(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return every STEP_PX-th row and column of the middle half of a picture."""
    rows, columns = shape[:2]
    return slice(rows // 4, rows - rows // 4, STEP_PX), slice(columns // 4, columns - columns // 4, STEP_PX)


def _points(depth_mm: DepthImage, camera: Intrinsics) -> tuple[FloatArray, float]:
    """Return readings of the middle in the camera's space [mm], shape (n, 3), and the share of pixels that have one."""
    row, column = np.mgrid[_middle(depth_mm.shape)]
    read_mm = depth_mm[row, column]
    is_read = read_mm > 0
    z_mm = read_mm[is_read].astype(np.float64)
    x_mm = (column[is_read] - camera.cx) / camera.fx * z_mm
    y_mm = (row[is_read] - camera.cy) / camera.fy * z_mm
    return np.column_stack((x_mm, y_mm, z_mm)), float(is_read.mean())


def _tilt_deg(points_mm: FloatArray) -> float:
    """Fit z = a x + b y + c to the readings near their median, twice, without the quarter that fits worst."""
    if len(points_mm) < MIN_READINGS:
        return math.nan
    kept = points_mm
    for _ in range(2):
        terms = np.column_stack((kept[:, :2], np.ones(len(kept))))
        weights, *_ = np.linalg.lstsq(terms, kept[:, 2], rcond=None)
        misfit_mm = np.abs(points_mm[:, :2] @ weights[:2] + weights[2] - points_mm[:, 2])
        kept = points_mm[misfit_mm <= np.quantile(misfit_mm, _TRIMMED_SHARE)]
    return math.degrees(math.atan(math.hypot(weights[0], weights[1])))
