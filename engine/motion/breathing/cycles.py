"""Statistics of a breathing signal: number of complete cycles, excursion, noise and speed."""

import numpy as np

from engine.core.frames import FloatArray

SMOOTHING_S = 0.4
MIN_EXCURSION_MM = 0.8
HYSTERESIS_SHARE = 0.2
# For normal noise: standard deviation over median absolute value; and of a second difference over that of a value.
SIGMA_OF_MEDIAN = 1.4826
SECOND_DIFFERENCE_GAIN = 6.0**0.5


def count_cycles(signal_mm: FloatArray, seconds: FloatArray) -> int:
    """Count complete breathing cycles: rises through the upper threshold after a fall through the lower one.

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
    smooth = smoothed(np.asarray(signal_mm, dtype=np.float64), seconds)
    low, high = np.percentile(smooth, [5.0, 95.0])
    if high - low < MIN_EXCURSION_MM:
        return 0
    middle, margin = 0.5 * (low + high), HYSTERESIS_SHARE * (high - low)
    side = np.zeros(len(smooth), dtype=np.int8)
    side[smooth > middle + margin] = 1
    side[smooth < middle - margin] = -1
    sides = side[side != 0]
    rises = int(((sides[1:] == 1) & (sides[:-1] == -1)).sum())
    return max(rises - 1, 0)


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
