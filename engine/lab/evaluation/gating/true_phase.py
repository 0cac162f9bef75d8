"""True breathing phase, known in retrospect: 0 % at every end of inhale, linear in time to the next."""

from itertools import pairwise

import numpy as np
from scipy.signal import find_peaks

from engine.core.frames import FloatArray

SHORTEST_BREATH_S = 1.5
PROMINENCE_SHARE = 0.4


def true_phase_percent(motion: FloatArray, seconds: FloatArray) -> FloatArray:
    """Return the phase [%], 0 to below 100, shape (n,); NaN before the first end of inhale and after the last.

    Parameters
    ----------
    motion
        The true signal, inhale positive, without noise, shape (n,).
    seconds
        Its times [s], evenly spaced, shape (n,).
    """
    step_s = float(seconds[1] - seconds[0])
    prominence = PROMINENCE_SHARE * float(np.ptp(np.percentile(motion, [5.0, 95.0])))
    peaks, _ = find_peaks(motion, distance=max(int(SHORTEST_BREATH_S / step_s), 1), prominence=prominence)
    phase = np.full(len(motion), np.nan)
    for start, end in pairwise(peaks.tolist()):
        phase[start:end] = 100.0 * np.arange(end - start) / (end - start)
    return phase
