"""What a structured-light camera's readings say of its errors: statistics of still surfaces, and a model of them.

Only blocks of 8 x 8 pixels count that are wholly read in every frame and that nothing moved: their mean has hardly a
trend and no step. Each pixel's line in time is taken off, so that a slow rest of motion is not taken for noise that is
correlated far in space and time. A model is judged by the same statistics of its readings of the same surface.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from scipy.optimize import minimize

from engine.core.errors import InvalidValueError
from engine.core.frames import BoolArray, FloatArray
from lab.evaluation.table import Cell, Table
from lab.phantom.rig import STEPS_A_MM
from lab.phantom.sensor import STEPS_A_PX, Holes, Sensor, SensorModel, Unit, find_sensor, shift_of

BANDS_MM = ((500.0, 700.0), (700.0, 900.0), (900.0, 1300.0))
BLOCK_PX = 8
MOST_TREND_MM, MOST_STEP_MM = 0.15, 1.5
"""Of a block's mean: most trend in a frame, and most step between two frames."""
LEAST_FRAMES, MOST_FRAMES = 8, 24
"""Of more frames noise alone makes a step in every block."""
LEAST_PIXELS = 1000
IN_TIME, IN_SPACE, SQUARES_PX = (1, 2, 3), (1, 2, 4, 8), (1, 2, 4, 8, 16, 32)
SURFACE_PX = 12.0
"""Smoothing that makes the surface of its readings, from which pattern and locking stand out."""
SEED, ROUNDS = 2017, 90
FITTED = ("noise_shifts", "white", "near", "near_px", "far_px")
BOUNDS = ((0.1, 1.0), (0.05, 0.6), (0.1, 0.6), (0.6, 2.0), (1.2, 6.0))
LENGTHS = {"in_time": IN_TIME, "along_rows": IN_SPACE, "along_columns": IN_SPACE, "squares_mm": SQUARES_PX}


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorStatistics:
    """Statistics of the still pixels in a band of depth.

    Attributes
    ----------
    band_mm
        Least and largest depth [mm].
    pixels
        How many still pixels there are.
    unchanged, by_one_step
        Share of the readings that are the frame's before, and that differ by one step.
    deviation_mm
        Standard deviation in time [mm].
    in_time, along_rows, along_columns
        Autocorrelation in time at `IN_TIME` frames, and in space at `IN_SPACE` pixels.
    squares_mm
        Standard deviation in time of means over squares of `SQUARES_PX` [mm]; NaN where none is wholly still.
    phases
        Share of the readings in each eighth of a pixel of disparity, times 8.
    pattern_mm
        Root mean square of what a pixel's mean lies off the surface [mm].
    columns_mm
        As ``pattern_mm``, of the columns' means.
    locking_px
        Amplitude of the first harmonic over the phase in what the readings lie off the surface [px of disparity].
    """

    band_mm: tuple[float, float]
    pixels: int
    unchanged: float
    by_one_step: float
    deviation_mm: float
    in_time: tuple[float, ...]
    along_rows: tuple[float, ...]
    along_columns: tuple[float, ...]
    squares_mm: tuple[float, ...]
    phases: tuple[float, ...]
    pattern_mm: float
    columns_mm: float
    locking_px: float


def statistics_of(depth_mm: FloatArray) -> list[SensorStatistics]:
    """Return the statistics of each band of depth with enough still pixels.

    Parameters
    ----------
    depth_mm
        Readings of consecutive frames [mm], shape (n, rows, columns), 0 for none.

    Raises
    ------
    InvalidValueError
        There are too few frames, or nothing is still.
    """
    if not LEAST_FRAMES <= len(depth_mm) <= MOST_FRAMES:
        raise InvalidValueError("frames", len(depth_mm), f"{LEAST_FRAMES} to {MOST_FRAMES}")
    depth_mm = depth_mm.astype(np.float32)
    still, mean_mm = _still(depth_mm), depth_mm.mean(axis=0)
    found = []
    for band_mm in BANDS_MM:
        inside = still & (mean_mm >= band_mm[0]) & (mean_mm < band_mm[1])
        if np.count_nonzero(inside) >= LEAST_PIXELS:
            found.append(_statistics(depth_mm, mean_mm, inside, band_mm))
    if not found:
        raise InvalidValueError(
            "still pixels", int(np.count_nonzero(still)), f"at least {LEAST_PIXELS} in a band of depth"
        )
    return found


def simulated(depth_mm: FloatArray, model: SensorModel) -> FloatArray:
    """Return what a model reads of the surface of a recording, moving as slowly as it did, of the same shape [mm]."""
    depth_mm = depth_mm.astype(np.float32)
    is_read = np.asarray((depth_mm > 0.0).all(axis=0))
    sensor = Sensor(Unit(scale=1.0, offset_mm=0.0), SEED, model)
    holes = Holes(level=np.where(is_read, -np.inf, np.inf).astype(np.float32), is_edge=np.zeros_like(is_read))
    mean_mm = np.where(is_read, _surface(depth_mm.mean(axis=0), is_read), np.float32(10_000.0))
    slope_mm = np.where(is_read, _surface(_slopes(depth_mm), is_read), np.float32(0.0))
    times = np.arange(len(depth_mm)) - (len(depth_mm) - 1) / 2.0
    return np.stack(
        [
            sensor.read(mean_mm + np.float32(time) * slope_mm, holes, frame=frame, time_s=1e6)
            for frame, time in enumerate(times)
        ]
    ).astype(np.float32)


def fit_sensor(depth_mm: FloatArray, on_round: Callable[[int], None] = lambda _done: None) -> SensorModel:
    """Fit the noise of a sensor model to a recording's statistics, by its size and its reach in space.

    Pattern and locking stay those of ``usual``: what a recording shows of them depends on its surfaces.
    """
    target = _features(statistics_of(depth_mm))
    done = 0

    def misfit(scaled: FloatArray) -> float:
        nonlocal done
        done += 1
        on_round(done)
        found = _features(statistics_of(simulated(depth_mm, _model(scaled))))
        common = target.keys() & found.keys()  # noise may hide what is still in a band
        return float(np.mean([np.square(found[one] - target[one]).sum() for one in common])) if common else np.inf

    best = minimize(
        misfit, np.full(len(FITTED), 0.4), method="Nelder-Mead", bounds=[(0.0, 1.0)] * 5, options={"maxfev": ROUNDS}
    )
    return _model(best.x)


def table(columns: dict[str, list[SensorStatistics]]) -> Table:
    """Return one row a band and statistic, with a column for the recording and for each model."""
    rows: list[tuple[Cell, ...]] = []
    for band_mm in BANDS_MM:
        of_band = [next((one for one in found if one.band_mm == band_mm), None) for found in columns.values()]
        if of_band[0] is None:
            continue
        for one in fields(SensorStatistics)[1:]:
            shown = (None if found is None else getattr(found, one.name) for found in of_band)
            rows.append((f"{band_mm[0]:.0f} to {band_mm[1]:.0f}", one.name, *map(_text, shown)))
    return Table(
        name="sensor",
        title="Statistics of still surfaces",
        columns=("depth, mm", "statistic", *columns),
        rows=tuple(rows),
        note=f"Lags in time {IN_TIME} frames, in space {IN_SPACE} px; squares of {SQUARES_PX} px; eighths of a pixel.",
    )


def _text(value: float | tuple[float, ...] | None) -> str | None:
    if value is None or isinstance(value, int):
        return None if value is None else str(value)
    numbers = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{number:.2f}" for number in numbers)


def _model(scaled: FloatArray) -> SensorModel:
    """Return the model of parameters that are scaled to their bounds, 0 to 1."""
    low, high = np.array(BOUNDS).T
    noise, white, near, near_px, far_px = (low + np.clip(scaled, 0.0, 1.0) * (high - low)).tolist()
    parts = ((white, 0.0), (near * (1.0 - white), near_px), ((1.0 - near) * (1.0 - white), far_px))
    return replace(find_sensor("usual"), noise_shifts=noise, noise_parts=parts)


def _features(found: list[SensorStatistics]) -> dict[tuple[float, float], FloatArray]:
    """Return what a fit compares in each band: shares, deviation in steps, correlation in space."""
    steps = [one.deviation_mm * STEPS_A_MM / np.mean(one.band_mm) ** 2 for one in found]
    return {
        one.band_mm: np.array([one.unchanged, one.by_one_step, step, *one.along_rows, *one.along_columns])
        for one, step in zip(found, steps, strict=True)
    }


def _still(depth_mm: FloatArray) -> BoolArray:
    """Return the pixels of still blocks, shape (rows, columns)."""
    means = np.stack([_blocks(frame, BLOCK_PX) for frame in depth_mm])
    read = np.stack([_blocks((frame > 0.0).astype(np.float32), BLOCK_PX) for frame in depth_mm]).min(axis=0) == 1.0
    still = read & (np.abs(_slopes(means)) < MOST_TREND_MM)
    still &= np.abs(np.diff(means, axis=0)).max(axis=0) < MOST_STEP_MM
    whole = np.zeros(depth_mm.shape[1:], dtype=np.bool_)
    spread = np.repeat(np.repeat(still, BLOCK_PX, axis=0), BLOCK_PX, axis=1)
    whole[: len(spread), : spread.shape[1]] = spread
    return whole


def _slopes(values: FloatArray) -> FloatArray:
    """Return the slope in time of each pixel [mm a frame]."""
    times = np.arange(len(values), dtype=np.float32) - np.float32((len(values) - 1) / 2.0)
    return np.asarray(np.tensordot(times, values, axes=1) / np.float32(np.square(times).sum()))


def _blocks(values: FloatArray, side: int) -> FloatArray:
    """Return means of whole squares, shape (rows // side, columns // side)."""
    rows, columns = (size // side for size in values.shape)
    return np.asarray(values[: rows * side, : columns * side].reshape(rows, side, columns, side).mean(axis=(1, 3)))


def _surface(values: FloatArray, inside: BoolArray) -> FloatArray:
    """Smooth what lies inside; zero elsewhere."""
    weight = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), SURFACE_PX)
    blurred = cv2.GaussianBlur(np.where(inside, values, np.float32(0.0)).astype(np.float32), (0, 0), SURFACE_PX)
    return np.asarray(blurred / np.maximum(weight, np.float32(1e-3)) * inside)


def _statistics(
    depth_mm: FloatArray, mean_mm: FloatArray, inside: BoolArray, band_mm: tuple[float, float]
) -> SensorStatistics:
    times = np.arange(len(depth_mm), dtype=np.float32) - np.float32((len(depth_mm) - 1) / 2.0)
    noise_mm = (depth_mm - mean_mm - times[:, None, None] * _slopes(depth_mm)) * inside
    readings = depth_mm[:, inside]
    steps = np.abs(np.diff(np.rint(STEPS_A_MM / readings), axis=0))
    variance = float(np.square(noise_mm[:, inside]).mean())
    phases = np.bincount(np.rint(STEPS_A_MM / readings).astype(np.intp).ravel() % STEPS_A_PX, minlength=STEPS_A_PX)
    surface_mm = _surface(mean_mm, inside)
    off_mm = (mean_mm - surface_mm) * inside
    phase = np.exp(2j * np.pi / STEPS_A_PX * shift_of(np.maximum(surface_mm[inside], np.float32(1.0))))
    off_px = off_mm[inside] * STEPS_A_MM / np.square(surface_mm[inside]) / STEPS_A_PX
    counts = inside.sum(axis=0)
    columns_mm = off_mm.sum(axis=0)[counts > BLOCK_PX] / counts[counts > BLOCK_PX]
    return SensorStatistics(
        band_mm=band_mm,
        pixels=int(np.count_nonzero(inside)),
        unchanged=float((steps < 0.5).mean()),
        by_one_step=float(((steps > 0.5) & (steps < 1.5)).mean()),
        deviation_mm=float(np.sqrt(variance)),
        in_time=tuple(float((noise_mm[lag:] * noise_mm[:-lag])[:, inside].mean()) / variance for lag in IN_TIME),
        along_rows=tuple(_correlation(noise_mm, inside, lag, variance) for lag in IN_SPACE),
        along_columns=tuple(_correlation(noise_mm.transpose(0, 2, 1), inside.T, lag, variance) for lag in IN_SPACE),
        squares_mm=tuple(_square_mm(noise_mm, inside, side) for side in SQUARES_PX),
        phases=tuple((phases / max(phases.mean(), 1e-9)).tolist()),
        pattern_mm=float(np.sqrt(np.square(off_mm[inside]).mean())),
        columns_mm=float(np.sqrt(np.square(columns_mm).mean())) if len(columns_mm) else float("nan"),
        locking_px=float(2.0 * np.abs((off_px * phase).mean())),
    )


def _correlation(noise_mm: FloatArray, inside: BoolArray, lag: int, variance: float) -> float:
    """Return the correlation of pixels that lie ``lag`` apart in a row."""
    pairs = inside[:, lag:] & inside[:, :-lag]
    return float((noise_mm[:, :, lag:] * noise_mm[:, :, :-lag])[:, pairs].mean()) / variance


def _square_mm(noise_mm: FloatArray, inside: BoolArray, side: int) -> float:
    """Return the standard deviation in time of the means of wholly still squares [mm]."""
    whole = _blocks(inside.astype(np.float32), side) == 1.0
    means = np.stack([_blocks(frame, side) for frame in noise_mm])[:, whole]
    return float(np.sqrt(np.square(means).mean())) if whole.any() else float("nan")
