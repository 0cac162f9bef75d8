"""Counts breathing cycles as commit 92d6c8d did, with one threshold for all breaths, as its tapes hold them."""

import numpy as np

from engine.motion.breathing import smoothed


def count_cycles(signal_mm, seconds):
    """Count the rises through the upper threshold after a fall through the lower one, less one."""
    if len(signal_mm) < 3 or seconds[-1] - seconds[0] < 1.0:
        return 0
    smooth = smoothed(np.asarray(signal_mm, dtype=np.float64), seconds)
    low, high = np.percentile(smooth, [5.0, 95.0])
    if high - low < 0.8:
        return 0
    middle, margin = 0.5 * (low + high), 0.2 * (high - low)
    side = np.zeros(len(smooth), dtype=np.int8)
    side[smooth > middle + margin] = 1
    side[smooth < middle - margin] = -1
    sides = side[side != 0]
    return max(int(((sides[1:] == 1) & (sides[:-1] == -1)).sum()) - 1, 0)
