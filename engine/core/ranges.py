"""What a signal was while the motion model was trained: its range, to which per cent refer, and its levels."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from engine.core.breath import SignalChoice
from engine.core.frames import FloatArray

PERCENTILES = (5.0, 95.0)
"""Of the levels in the training: the end of exhale, and the end of inhale."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedRange:
    """End of exhale (``low``) and end of inhale (``high``) against the present reference [mm, l of the volume]."""

    low: float
    high: float

    def percent(self, level: float) -> float:
        """Return the place of a level in the range: 0 at the end of exhale, 100 at the end of inhale."""
        return 100.0 * (level - self.low) / (self.high - self.low)


Ranges = Mapping[SignalChoice, LearnedRange]
"""Signals whose range is not known are absent."""

LearnedLevels = Mapping[SignalChoice, FloatArray]
"""Levels against the present reference [mm, l of the volume] in training frames evenly spread over the training, shape
(n,), of the same frames for each signal. Signals whose levels are not known are absent."""


def ranges_of(levels: LearnedLevels) -> Ranges:
    """Return the range of each signal from its levels; signals that did not move are left out."""
    found = {}
    for choice, values in levels.items():
        low, high = np.percentile(values, PERCENTILES)
        if high > low:
            found[choice] = LearnedRange(low=float(low), high=float(high))
    return found
