"""Readings of a flat plate by a depth camera: distance, flatness, noise, and drift while it warms up.

The mean over many frames, holes left out, is fitted as a plane in 1/z, where a plane is linear in the rays and the
sensor's noise is the same at every depth; the fit is made again without what lies off it. Readings have no depth
correction; the sensor's rounding is undone where a session would undo it too.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from engine.calibration.camera_calibration import Calibration
from engine.calibration.quantisation import DEPTH_VALUES, DepthSteps, count_readings, depth_table_mm, find_steps
from engine.capture.oni.reader import OniReader
from engine.core.errors import CalibrationError
from engine.core.frames import BoolArray, DepthImage, FloatArray

FEWEST_FRAMES, MOST_FRAMES = 30, 9000
LARGEST_TILT_DEG = 10.0
ROUGHEST_SHARE = 0.004
LEAST_PLATE_SHARE = 0.8
NARROWEST_PART = 0.2
# A pixel counts where it had a reading in most frames.
_SEEN_SHARE = 0.8
# A second: the unit of drift; and one picture of it is enough to see the depths that occur.
_BLOCK_FRAMES = 30
_STEP_PX = 2
_ROUNDS = 5
_SIGMAS = 4.0
_NARROWEST_MM, _WIDEST_SHARE = 1.5, 0.01
_PATCHES = 12
_SIGMA_OF_MAD = 1.4826


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateReading:
    """One recording of a plate.

    Parameters
    ----------
    name, frames, seconds
        The recording.
    reading_mm
        Distance of the plate along the optical axis, as read.
    tilt_deg
        Between the plate's normal and the optical axis.
    flatness_mm
        Root mean square of the plate's deviation from a plane, in patches a twelfth of the part's side.
    noise_mm
        One pixel's standard deviation from frame to frame, the median over the plate.
    drift_mm
        Drift of the reading from the beginning to the end, by a straight line through its seconds; None where there
        are fewer than two.
    tilt_x_deg, tilt_y_deg
        The tilt along the picture's rows and columns; positive where the plate is nearer at the right, at the bottom.
    missing_share
        Share of the part's pixels without a reading, over all frames.
    track
        The reading in each second of the recording, as (time from its beginning [s], reading [mm]).
    """

    name: str
    frames: int
    seconds: float
    reading_mm: float
    tilt_deg: float
    flatness_mm: float
    noise_mm: float
    drift_mm: float | None
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    missing_share: float = 0.0
    track: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Plane:
    """``1/z = a x + b y + c`` over rays (x, y, 1), and which pixels lie on it."""

    a: float
    b: float
    c: float
    is_on: BoolArray
    residual_mm: FloatArray

    @property
    def depth_mm(self) -> float:
        return 1.0 / self.c

    @property
    def tilt_deg(self) -> float:
        return float(np.degrees(np.arctan(np.hypot(self.a, self.b) / self.c)))


def find_plate_steps(paths: Sequence[Path]) -> DepthSteps | None:
    """Find the sensor's steps of 1/z in recordings together, as a session does; None where they do not show."""
    counts = np.zeros(DEPTH_VALUES, np.int64)
    for path in paths:
        with OniReader(path) as reader:
            depths = (frame for frame in reader.frames() if frame.is_depth)
            for frame in itertools.islice(depths, 0, MOST_FRAMES, _BLOCK_FRAMES):
                counts += count_readings(frame.decode_depth())
    return find_steps(counts)


def read_plate(
    path: Path,
    calibration: Calibration,
    *,
    steps: DepthSteps | None = None,
    part: float = 0.5,
    on_progress: Callable[[int], None] = lambda _frames: None,
) -> PlateReading:
    """Read a plate's recording.

    Parameters
    ----------
    steps
        The sensor's steps, where known: whole millimetres of two-millimetre steps are off by up to half of one, and on
        a plate that faces the camera only a few of them occur.
    part
        Share of the picture's width and height, in the middle, that the plate fills.

    Raises
    ------
    RecordingError
        The recording cannot be read.
    CalibrationError
        Not a recording of this camera's size, too short, or no flat plate that faces the camera.
    """
    with OniReader(path) as reader:
        return read_plate_frames(
            path.name, _depths(reader), calibration, steps=steps, part=part, on_progress=on_progress
        )


def read_plate_frames(
    name: str,
    frames: Iterable[tuple[DepthImage, int]],
    calibration: Calibration,
    *,
    steps: DepthSteps | None = None,
    part: float = 0.5,
    on_progress: Callable[[int], None] = lambda _frames: None,
) -> PlateReading:
    """Read a plate from depth pictures with their device times [us], wherever they come from; no more than needed.

    Raises
    ------
    CalibrationError
        As :func:`read_plate`.
    """
    if not NARROWEST_PART <= part <= 1.0:
        raise CalibrationError("part", part, f"from {NARROWEST_PART:g} to 1")
    window = _Window(calibration, part)
    sums = _Sums(window, np.nan_to_num(depth_table_mm(steps)))
    for picture, timestamp_us in itertools.islice(frames, MOST_FRAMES):
        window.check(name, picture)
        sums.add(picture, timestamp_us)
        on_progress(sums.frames)
    return _judge(name, sums, window)


def _depths(reader: OniReader) -> Iterator[tuple[DepthImage, int]]:
    for frame in reader.frames():
        if frame.is_depth:
            yield frame.decode_depth(), frame.timestamp_us


class _Window:
    """The middle of the picture, every second pixel, with its rays."""

    def __init__(self, calibration: Calibration, part: float) -> None:
        camera = calibration.depth
        self._shape = (camera.height, camera.width)
        margins = [round(side * (1.0 - part) / 2.0) for side in self._shape]
        self.cut = tuple(
            slice(margin, side - margin, _STEP_PX) for margin, side in zip(margins, self._shape, strict=True)
        )
        rows, columns = np.mgrid[self.cut]
        self.shape = rows.shape
        rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
        self.rays: FloatArray = rays

    def check(self, name: str, picture: DepthImage) -> None:
        """Refuse pictures of another size."""
        if picture.shape != self._shape:
            bound = f"{self._shape[1]} x {self._shape[0]} px, as the calibration is"
            raise CalibrationError(name, f"{picture.shape[1]} x {picture.shape[0]} px", bound)


class _Sums:
    """Sums over frames, in all and of the present second; 0 is no reading and takes no part."""

    def __init__(self, window: _Window, table_mm: FloatArray) -> None:
        self._window = window
        self._table_mm = table_mm
        self.frames = 0
        self.first_us = self.last_us = 0
        self.seen = np.zeros(window.shape, np.int32)
        self.total = np.zeros(window.shape, np.float64)
        self.squares = np.zeros(window.shape, np.float64)
        self.blocks: list[tuple[float, FloatArray]] = []
        self._block_seen = np.zeros(window.shape, np.int32)
        self._block_total = np.zeros(window.shape, np.float64)

    def add(self, picture: DepthImage, timestamp_us: int) -> None:
        """Take a frame."""
        readings = picture[self._window.cut]
        is_seen = readings > 0
        depth = self._table_mm[readings].astype(np.float64)
        self.first_us = timestamp_us if self.frames == 0 else self.first_us
        self.last_us = timestamp_us
        self.frames += 1
        self.total += depth
        self.squares += np.square(depth)
        self.seen += is_seen
        self._block_total += depth
        self._block_seen += is_seen
        if self.frames % _BLOCK_FRAMES == 0:
            mean = _mean(self._block_total, self._block_seen, _BLOCK_FRAMES)
            self.blocks.append(((timestamp_us - self.first_us) / 1e6, mean))
            self._block_total[:] = 0.0
            self._block_seen[:] = 0

    @property
    def mean_mm(self) -> FloatArray:
        """Mean reading a pixel, NaN where there hardly was one."""
        return _mean(self.total, self.seen, self.frames)

    @property
    def noise_mm(self) -> FloatArray:
        """Standard deviation a pixel."""
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = self.squares / self.seen - np.square(self.total / self.seen)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _mean(total: FloatArray, seen: npt.NDArray[np.int32], frames: int) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(seen >= _SEEN_SHARE * frames, total / seen, np.nan))


def _judge(name: str, sums: _Sums, window: _Window) -> PlateReading:
    if sums.frames < FEWEST_FRAMES:
        raise CalibrationError(name, f"{sums.frames} frames", f"at least {FEWEST_FRAMES} frames (10 s are good)")
    mean_mm = sums.mean_mm
    plane = _fit_plane(name, mean_mm, window)
    share = float(plane.is_on.mean())
    if share < LEAST_PLATE_SHARE:
        bound = f"one flat plate on {100 * LEAST_PLATE_SHARE:.0f} % of the middle of the picture at least"
        raise CalibrationError(name, f"{100 * share:.0f} % of it lies on a plane", bound)
    if plane.tilt_deg > LARGEST_TILT_DEG:
        bound = f"facing the camera within {LARGEST_TILT_DEG:g} degrees"
        raise CalibrationError(name, f"tilted by {plane.tilt_deg:.1f} degrees", bound)
    flatness_mm = _flatness_mm(plane, window)
    if flatness_mm > ROUGHEST_SHARE * plane.depth_mm:
        bound = f"flat to {ROUGHEST_SHARE * plane.depth_mm:.1f} mm"
        raise CalibrationError(name, f"{flatness_mm:.1f} mm off a plane", bound)
    return PlateReading(
        name=name,
        frames=sums.frames,
        seconds=(sums.last_us - sums.first_us) / 1e6,
        reading_mm=plane.depth_mm,
        tilt_deg=plane.tilt_deg,
        flatness_mm=flatness_mm,
        noise_mm=float(np.median(sums.noise_mm[plane.is_on])),
        drift_mm=_drift_mm(sums, mean_mm, plane),
        tilt_x_deg=float(np.degrees(np.arctan(plane.a / plane.c))),
        tilt_y_deg=float(np.degrees(np.arctan(plane.b / plane.c))),
        missing_share=1.0 - float(sums.seen.mean()) / sums.frames,
        track=tuple((at_s, plane.depth_mm + moved_mm) for at_s, moved_mm in _moved_mm(sums, mean_mm, plane)),
    )


def _fit_plane(name: str, mean_mm: FloatArray, window: _Window) -> _Plane:
    depth_mm = mean_mm.ravel()
    is_on = np.isfinite(depth_mm)
    if is_on.mean() < LEAST_PLATE_SHARE / 2.0:
        bound = f"seen on {100 * LEAST_PLATE_SHARE:.0f} % of the middle of the picture at least"
        raise CalibrationError(name, f"{100 * float(is_on.mean()):.0f} % of it has readings", bound)
    known = is_on.copy()
    with np.errstate(invalid="ignore"):
        inverse = 1.0 / depth_mm
    # The middle value first: what surrounds a plate is farther, and must not pull the first fit.
    middle = float(np.median(depth_mm[known]))
    is_on &= np.abs(depth_mm - middle) < 0.15 * middle
    coefficients, residual_mm = np.array([0.0, 0.0, 1.0 / middle]), np.full(depth_mm.shape, np.nan)
    for _ in range(_ROUNDS):
        coefficients, *_ = np.linalg.lstsq(window.rays[is_on], inverse[is_on], rcond=None)
        residual_mm = depth_mm - 1.0 / (window.rays @ coefficients)
        spread = _SIGMA_OF_MAD * float(np.median(np.abs(residual_mm[is_on])))
        bound_mm = float(np.clip(_SIGMAS * spread, _NARROWEST_MM, _WIDEST_SHARE * middle))
        is_on = known & (np.abs(np.where(known, residual_mm, np.inf)) < bound_mm)
        if is_on.mean() < LEAST_PLATE_SHARE / 4.0:
            break
    a, b, c = (float(value) for value in coefficients)
    if c <= 0.0:
        raise CalibrationError(name, "no plane before the camera", "a flat plate")
    shape = mean_mm.shape
    return _Plane(a=a, b=b, c=c, is_on=is_on.reshape(shape), residual_mm=residual_mm.reshape(shape))


def _flatness_mm(plane: _Plane, window: _Window) -> float:
    """Average the residuals over patches, so that what is left is the plate's shape and the lens, not noise."""
    residual_mm = np.where(plane.is_on, plane.residual_mm, np.nan)
    patches = [
        np.nanmean(patch)
        for strip in np.array_split(residual_mm, min(_PATCHES, window.shape[0]), axis=0)
        for patch in np.array_split(strip, min(_PATCHES, window.shape[1]), axis=1)
        if np.isfinite(patch).any()
    ]
    return float(np.sqrt(np.mean(np.square(patches))))


def _drift_mm(sums: _Sums, mean_mm: FloatArray, plane: _Plane) -> float | None:
    """Fit a line through how far each second's mean lies from the whole recording's."""
    moved = _moved_mm(sums, mean_mm, plane)
    if len(moved) < 2:
        return None  # nothing to draw a line through: not measured, which is not "does not drift"
    times_s, moved_mm = np.array(moved).T
    slope = float(np.polyfit(times_s, moved_mm, 1)[0])
    return slope * float(times_s[-1])


def _moved_mm(sums: _Sums, mean_mm: FloatArray, plane: _Plane) -> list[tuple[float, float]]:
    """How far each second's mean lies from the whole recording's, as (time [s], mm); a second unseen is left out."""
    moved = [(at_s, (block - mean_mm)[plane.is_on]) for at_s, block in sums.blocks]
    return [(at_s, float(np.nanmean(by_mm))) for at_s, by_mm in moved if np.isfinite(by_mm).any()]
