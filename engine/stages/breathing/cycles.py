"""What a motion signal says about breathing: how many complete cycles it holds, how deep, how noisy, how fast."""

import numpy as np

from engine.frames import FloatArray

SMOOTHING_S = 0.4
MIN_EXCURSION_MM = 0.8
HYSTERESIS_SHARE = 0.2
# Of a normal value: its standard deviation over the median of its absolute value; and of a second difference over it.
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
        0 when nothing moves by more than 0.8 mm or the signal is shorter than a second.
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
    """How deep a signal breathes: 5th to 95th percentile, smoothed over 0.4 s [mm]; 0 for under three samples."""
    if len(signal_mm) < 3:
        return 0.0
    low, high = np.percentile(smoothed(np.asarray(signal_mm, dtype=np.float64), seconds), [5.0, 95.0])
    return float(high - low)


def noise_mm(signal_mm: FloatArray) -> float:
    """Tell the standard deviation of what changes between samples without being motion [mm]; 0 for under three.

    From second differences, which a breath hardly has at 30 frames a second, and their median, which a cough or a jump
    does not bend.
    """
    if len(signal_mm) < 3:
        return 0.0
    second = np.diff(np.asarray(signal_mm, dtype=np.float64), n=2)
    return float(SIGMA_OF_MEDIAN * np.median(np.abs(second)) / SECOND_DIFFERENCE_GAIN)


def speed_mm_s(signal_mm: FloatArray, seconds: FloatArray) -> FloatArray:
    """How fast a signal moves at each sample, smoothed over 0.4 s [mm/s], shape (n,); zeros for under three samples."""
    if len(signal_mm) < 3:
        return np.zeros(len(signal_mm))
    smooth = smoothed(np.asarray(signal_mm, dtype=np.float64), seconds)
    steps = np.maximum(np.gradient(seconds), 1e-3)
    return np.abs(np.gradient(smooth) / steps)


def smoothed(signal: FloatArray, seconds: FloatArray) -> FloatArray:
    """Average a signal over 0.4 s around each sample, shape (n,)."""
    period = float(np.median(np.diff(seconds)))
    width = max(1, round(SMOOTHING_S / max(period, 1e-3)))
    padded = np.pad(signal, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
