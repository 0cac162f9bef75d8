"""What a motion signal says about breathing: so far, how many complete cycles it holds."""

import numpy as np

from engine.frames import FloatArray

SMOOTHING_S = 0.4
MIN_EXCURSION_MM = 0.8
HYSTERESIS_SHARE = 0.2


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
    smooth = _smoothed(np.asarray(signal_mm, dtype=np.float64), seconds)
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


def _smoothed(signal: FloatArray, seconds: FloatArray) -> FloatArray:
    period = float(np.median(np.diff(seconds)))
    width = max(1, round(SMOOTHING_S / max(period, 1e-3)))
    padded = np.pad(signal, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
