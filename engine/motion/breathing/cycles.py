"""Turning points and cycles of a breathing signal; its excursion, noise and speed, and its rest. In mm and s.

An extreme is a turning point once the signal has left it by a threshold; cycles are counted by turning points. A swing
is a breath if it exceeds a share of the excursion within 6 s of it, so that one sigh or a slow drift does not hide the
breaths beside it, and if it exceeds the signal's noise.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from engine.core.frames import FloatArray
from engine.core.replacing import replace

RISING, FALLING, UNKNOWN = 1, -1, 0

BIN_S = 0.1

LEVEL_BINS = 6
"""The level is the mean over this many bins, about one heartbeat, which it averages out."""

SPEED_BINS = 3

STILL_SHARE = 0.2

MIN_STILL_MM = 0.6

SMOOTHING_S = 0.4

MIN_EXCURSION_MM = 0.8
"""Least swing of a breath: the heart alone moves a chest by some tenths of a millimetre."""

LOCAL_S = 6.0
"""Time before and after a value over which its local excursion is computed: about two breaths in all [s]."""

LOCAL_PERCENTILES = (15.0, 85.0)

LOCAL_SHARE = 0.3

GLOBAL_SHARE = 0.1

NOISE_FACTOR = 4.0

SPIKE_FRAMES = 5
"""Frames of a median filter that removes single damaged frames before breaths are counted."""

LOCAL_STEP_S = 0.1

LOCAL_EVERY = 5

CYCLE_S = (1.2, 15.0)
"""Shortest and longest breathing cycle; a shorter one is a cough, a longer one contains a held breath [s]."""

# For normal noise: standard deviation over median absolute value; and of a second difference over that of a value.
SIGMA_OF_MEDIAN = 1.4826

SECOND_DIFFERENCE_GAIN = 6.0**0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class TurningPoints:
    """State of the detector: direction, and the extremes since the last turning point.

    Attributes
    ----------
    direction
        ``RISING`` until the next peak, ``FALLING`` until the next trough, ``UNKNOWN`` before the first turning point.
    high, high_s, low, low_s
        Extremes since the last turning point, and their times [s].
    turned_s
        When the last turning point was detected [s].
    """

    direction: int = UNKNOWN
    high: float = float("-inf")
    high_s: float = 0.0
    low: float = float("inf")
    low_s: float = 0.0
    turned_s: float = 0.0


def follow_turns(turns: TurningPoints, seconds: float, value: float, threshold: float) -> tuple[TurningPoints, bool]:
    """Add a value; return the state and whether a turning point was detected.

    After a turn to rising, ``low`` is the trough and ``high`` restarts; after a turn to falling, the reverse.
    """
    if value > turns.high:
        turns = replace(turns, high=value, high_s=seconds)
    if value < turns.low:
        turns = replace(turns, low=value, low_s=seconds)
    if turns.direction != RISING and value - turns.low > threshold:
        return replace(turns, direction=RISING, high=value, high_s=seconds, turned_s=seconds), True
    if turns.direction != FALLING and turns.high - value > threshold:
        return replace(turns, direction=FALLING, low=value, low_s=seconds, turned_s=seconds), True
    return turns, False


@dataclass(frozen=True, slots=True, kw_only=True)
class Bins:
    """State of the bins.

    Attributes
    ----------
    values
        Means of the last closed bins.
    open_s, total, count
        Start of the open bin, and the sum and number of its values.
    still_at, still_s
        Level at which the signal came to rest, and when; it has not left it since.
    """

    values: tuple[float, ...] = ()
    open_s: float = 0.0
    total: float = 0.0
    count: int = 0
    still_at: float = 0.0
    still_s: float = 0.0

    @property
    def level(self) -> float:
        """Mean over the last 0.6 s, or over fewer bins at the start."""
        return sum(self.values) / len(self.values)

    @property
    def is_level_known(self) -> bool:
        """Whether the level is the mean over the full 0.6 s."""
        return len(self.values) == LEVEL_BINS

    @property
    def short_level(self) -> float:
        """Mean over the last 0.3 s."""
        last = self.values[-SPEED_BINS:]
        return sum(last) / len(last) if last else math.nan

    @property
    def speed(self) -> float:
        """Speed of the signal over the last 0.3 s [mm/s]."""
        if len(self.values) <= SPEED_BINS:
            return 0.0
        return (self.values[-1] - self.values[-1 - SPEED_BINS]) / (SPEED_BINS * BIN_S)


def follow_bins(bins: Bins, seconds: float, value: float, amplitude: float) -> tuple[Bins, bool]:
    """Add a value; return the bins and whether one was closed. ``amplitude`` is that of a usual breath [mm]."""
    if bins.count == 0:
        return replace(bins, open_s=seconds, total=value, count=1, still_at=value, still_s=seconds), False
    if seconds - bins.open_s < BIN_S - 1e-6:
        return replace(bins, total=bins.total + value, count=bins.count + 1), False
    mean = bins.total / bins.count
    # With a slow camera a value lasts several bins: repeat it.
    lasted = min(max(1, round((seconds - bins.open_s) / BIN_S)), LEVEL_BINS)
    values = (*bins.values, *(mean,) * lasted)[-LEVEL_BINS:]
    closed = replace(bins, values=values, open_s=seconds, total=value, count=1)
    if abs(mean - bins.still_at) > max(MIN_STILL_MM, STILL_SHARE * amplitude):
        closed = replace(closed, still_at=mean, still_s=bins.open_s)
    return closed, True


def count_cycles(signal_mm: FloatArray, seconds: FloatArray) -> int:
    """Count complete breathing cycles: from one turning point to the next of the same kind.

    Parameters
    ----------
    signal_mm
        Motion [mm], shape (n,), any offset and sign.
    seconds
        Time of each sample [s], ascending, shape (n,).

    Returns
    -------
    int
        0 if the excursion is below 0.8 mm or the signal is shorter than 1 s.
    """
    if len(signal_mm) < 3 or seconds[-1] - seconds[0] < 1.0:
        return 0
    signal = np.asarray(signal_mm, dtype=np.float64)
    padded = np.pad(signal, SPIKE_FRAMES // 2, mode="edge")
    smooth = smoothed(np.median(sliding_window_view(padded, SPIKE_FRAMES), axis=1), seconds)
    low, high = np.percentile(smooth, [5.0, 95.0])
    if high - low < MIN_EXCURSION_MM:
        return 0
    noise = SIGMA_OF_MEDIAN * float(np.median(np.abs(signal - smooth)))
    least_mm = max(MIN_EXCURSION_MM, NOISE_FACTOR * noise, GLOBAL_SHARE * (high - low))
    threshold_mm = np.maximum(least_mm, LOCAL_SHARE * _local_excursion_mm(smooth, seconds))
    turns = _without_coughs(_turning_points(smooth, seconds, threshold_mm))
    cycles = at = 0
    while at + 2 < len(turns):
        is_breath = turns[at + 2][0] - turns[at][0] <= CYCLE_S[1]
        cycles, at = cycles + is_breath, at + 1 + is_breath
    return cycles


def _local_excursion_mm(smooth: FloatArray, seconds: FloatArray) -> FloatArray:
    """Excursion of the signal around each sample [mm], shape (n,)."""
    period = max(float(np.median(np.diff(seconds))), 1e-3)
    step = max(1, round(LOCAL_STEP_S / period))
    thin = smooth[::step]
    half = max(1, round(LOCAL_S / (step * period)))
    first = np.arange(0, len(thin), LOCAL_EVERY)
    # NaN beyond both ends, where the excursion is that of the samples there are.
    padded = np.concatenate([np.full(half, np.nan), thin, np.full(half, np.nan)])
    ordered = np.sort(sliding_window_view(padded, 2 * half + 1)[first], axis=1)  # NaN comes last
    counts = np.isfinite(ordered).sum(axis=1)
    low, high = (
        ordered[np.arange(len(first)), np.round(percentile / 100.0 * (counts - 1)).astype(np.intp)]
        for percentile in LOCAL_PERCENTILES
    )
    return np.asarray(np.interp(np.arange(len(smooth)), first * step, high - low))


def _turning_points(smooth: FloatArray, seconds: FloatArray, threshold_mm: FloatArray) -> list[tuple[float, float]]:
    """Return time [s] and value [mm] of each turning point; ends of inhale and of exhale alternate."""
    slopes = np.sign(np.diff(smooth))
    bends = np.flatnonzero(slopes[1:] != slopes[:-1]) + 1  # only there can the signal turn
    turns, found = TurningPoints(), []
    for at in [0, *bends.tolist(), len(smooth) - 1]:
        turns, has_turned = follow_turns(turns, float(seconds[at]), float(smooth[at]), float(threshold_mm[at]))
        if has_turned:
            is_trough = turns.direction == RISING
            found.append((turns.low_s, turns.low) if is_trough else (turns.high_s, turns.high))
    # The first sample is the beginning of the signal, not a turning point.
    return [turn for turn in found if turn[0] > seconds[0]]


def _without_coughs(turns: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Drop the smaller swing of each cycle that is too short for a breath."""
    kept, at = list(turns), 0
    while at + 2 < len(kept):
        if kept[at + 2][0] - kept[at][0] >= CYCLE_S[0]:
            at += 1
            continue
        first, second = (abs(kept[at + 1 + i][1] - kept[at + i][1]) for i in (0, 1))
        smaller = at if first <= second else at + 1
        del kept[smaller : smaller + 2]
        at = max(smaller - 2, 0)
    return kept


def excursion_mm(signal_mm: FloatArray, seconds: FloatArray) -> float:
    """Excursion of a signal: 5th to 95th percentile, smoothed over 0.4 s [mm]; 0 for fewer than three samples."""
    if len(signal_mm) < 3:
        return 0.0
    low, high = np.percentile(smoothed(np.asarray(signal_mm, dtype=np.float64), seconds), [5.0, 95.0])
    return float(high - low)


def noise_mm(signal_mm: FloatArray) -> float:
    """Estimate the standard deviation of a signal's noise [mm]; 0 for fewer than three samples.

    From the median of second differences: at 30 frames/s breathing contributes little to them, and single coughs or
    jumps do not change the median.
    """
    if len(signal_mm) < 3:
        return 0.0
    second = np.diff(np.asarray(signal_mm, dtype=np.float64), n=2)
    return float(SIGMA_OF_MEDIAN * np.median(np.abs(second)) / SECOND_DIFFERENCE_GAIN)


def speed_mm_s(signal_mm: FloatArray, seconds: FloatArray) -> FloatArray:
    """Absolute speed at each sample, smoothed over 0.4 s [mm/s], shape (n,); zeros for fewer than three samples."""
    if len(signal_mm) < 3:
        return np.zeros(len(signal_mm))
    smooth = smoothed(np.asarray(signal_mm, dtype=np.float64), seconds)
    steps = np.maximum(np.gradient(seconds), 1e-3)
    return np.abs(np.gradient(smooth) / steps)


def smoothed(signal: FloatArray, seconds: FloatArray) -> FloatArray:
    """Average a signal over 0.4 s around each sample, same shape (n,)."""
    period = float(np.median(np.diff(seconds)))
    width = max(1, round(SMOOTHING_S / max(period, 1e-3)))
    padded = np.pad(signal, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
