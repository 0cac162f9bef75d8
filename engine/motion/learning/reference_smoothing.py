"""Smooths a new reference over the last half second.

The noise of a single reference frame would enter every motion measured from it. The last frames are therefore projected
again, and a parabola fitted to each coefficient gives its value at the newest frame: half the noise, without lag.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from engine.core.frames import BoolArray, FloatArray, Projection, RoiDepth
from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.stages.projection import STRIDE_PX, project

FRAMES = 15
WINDOW_US = 500_000  # over a longer time a breath is not a parabola
MIN_FRAMES = 7
MAX_GAP_US = 100_000
DEGREE = 2


class Smoothed(NamedTuple):
    """Coefficients, shape (k + e,), and the share of the frames in which each sampled point was seen, (88, 50)."""

    coefficients: FloatArray
    seen: FloatArray | BoolArray


class RecentFrames:
    """Buffer of the region's last consecutive frames."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, RoiDepth]] = deque(maxlen=FRAMES)

    def add(self, roi: RoiDepth, timestamp_us: int) -> None:
        """Add a frame; a gap clears the frames before it."""
        if self._frames and not 0 < timestamp_us - self._frames[-1][0] <= MAX_GAP_US:
            self.reset()
        self._frames.append((timestamp_us, roi.thinned(STRIDE_PX)))

    def reset(self) -> None:
        """Clear the buffer."""
        self._frames.clear()

    def smoothed(self, active: PreparedModel, newest: Projection) -> Smoothed:
        """Return the smoothed coefficients of the newest frame; its own if there are too few frames."""
        since_us = self._frames[-1][0] - WINDOW_US if self._frames else 0
        recent = [(stamp, roi) for stamp, roi in self._frames if stamp >= since_us]
        explained = [(stamp, project(active.basis, roi, newest.coefficients)) for stamp, roi in recent]
        usable = [(stamp, found) for stamp, found in explained if found is not None]
        if len(usable) < MIN_FRAMES:
            return Smoothed(coefficients=newest.coefficients, seen=newest.is_seen)
        seconds = np.array([stamp - usable[-1][0] for stamp, _ in usable]) / 1e6
        coefficients = np.array([found.coefficients for _, found in usable])
        parabola = np.polynomial.polynomial.polyfit(seconds, coefficients, DEGREE)
        seen = np.mean([found.is_seen for _, found in usable], axis=0)
        return Smoothed(coefficients=np.asarray(parabola[0]), seen=seen)
