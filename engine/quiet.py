"""Where the patient was over the last half second: a steadier zero than a single frame.

The frame that becomes the reference puts its own noise into every motion measured against it. So the last frames are
explained once more, and a parabola through each coefficient says what it is at the newest: half the noise, and no lag.
"""

from collections import deque

import numpy as np

from engine.active_model import ActiveModel
from engine.frames import FloatArray, Projection, RoiDepth
from engine.stages.projection import STRIDE_PX, project

FRAMES = 15
WINDOW_US = 500_000  # a breath bends more than a parabola over longer, whatever the frame rate
MIN_FRAMES = 7
MAX_GAP_US = 100_000
DEGREE = 2


class RecentFrames:
    """The last frames of the region, without a gap."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, RoiDepth]] = deque(maxlen=FRAMES)

    def add(self, roi: RoiDepth, timestamp_us: int) -> None:
        """Take a frame; after a gap only what follows it counts."""
        if self._frames and not 0 < timestamp_us - self._frames[-1][0] <= MAX_GAP_US:
            self.forget()
        self._frames.append((timestamp_us, roi.thinned(STRIDE_PX)))

    def forget(self) -> None:
        """Begin anew: the patient was not seen."""
        self._frames.clear()

    def settled(self, active: ActiveModel, newest: Projection) -> FloatArray:
        """Coefficients of the newest frame as the last frames together say; its own where they are too few."""
        since_us = self._frames[-1][0] - WINDOW_US if self._frames else 0
        recent = [(stamp, roi) for stamp, roi in self._frames if stamp >= since_us]
        explained = [(stamp, project(active.basis, roi, newest.coefficients)) for stamp, roi in recent]
        usable = [(stamp, found.coefficients) for stamp, found in explained if found is not None]
        if len(usable) < MIN_FRAMES:
            return newest.coefficients
        seconds = np.array([stamp - usable[-1][0] for stamp, _ in usable]) / 1e6
        parabola = np.polynomial.polynomial.polyfit(seconds, np.array([found for _, found in usable]), DEGREE)
        return np.asarray(parabola[0])
