"""Statistics of a breathing signal: number of complete cycles, excursion, noise and speed.

Cycles are counted by turning points. A swing is a breath if it exceeds a share of the excursion within 6 s of it, so
that one sigh or a slow drift does not hide the breaths beside it, and if it exceeds the signal's noise.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from engine.core.frames import FloatArray
from engine.motion.breathing.turning_points import RISING, TurningPoints, follow_turns

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
