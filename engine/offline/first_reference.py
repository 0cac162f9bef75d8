"""The reference of a second pass: the first frame that it measures, smoothed over the half second behind it.

A live session smooths its reference over the half second before it, with a parabola (see
`engine.motion.learning.reference_transfer`). Before the first frame of a recording there is nothing, so the parabola
is fitted to the frames behind.
"""

from collections.abc import Iterable
from dataclasses import replace
from itertools import takewhile

import numpy as np

from engine.core.frames import FloatArray, Measurement, Motion, frozen
from engine.motion.learning.prepared_model import Reference
from engine.motion.learning.reference_transfer import DEGREE, FRAMES, MAX_GAP_US, MIN_FRAMES, WINDOW_US


class FirstFrames:
    """Collects the first measured frames of a recording, up to the first gap."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, Motion]] = []
        self.is_complete = False
        """Whether there are enough frames, or a gap behind the first ones."""

    def add(self, measurement: Measurement) -> None:
        """Add the next frame of the recording."""
        motion, at_us = measurement.motion, measurement.timestamp_us
        if motion is None:
            self.is_complete = bool(self._frames)
            return
        last_us = self._frames[-1][0] if self._frames else at_us - 1
        if not 0 < at_us - last_us <= MAX_GAP_US:
            self.is_complete = True
            return
        self._frames.append((at_us, motion))
        self.is_complete = len(self._frames) == FRAMES

    def smoothed(self, reference: Reference) -> Reference:
        """Return ``reference``, the first of these frames, with less of that frame's noise."""
        first_us = self._frames[0][0] if self._frames else 0
        recent = list(takewhile(lambda frame: frame[0] - first_us <= WINDOW_US, self._frames))
        if len(recent) < MIN_FRAMES:
            return reference
        seconds = np.array([at_us - first_us for at_us, _ in recent]) / 1e6
        at_first = np.linalg.pinv(np.polynomial.polynomial.polyvander(seconds, DEGREE))[0]
        # Motion of the first frame itself is 0: what the parabola has there is that frame's noise.
        noise_mm = at_first @ np.array([_regions_mm(motion) for _, motion in recent])
        volume_l = float(at_first @ np.array([motion.volume_l for _, motion in recent]))
        return replace(
            reference,
            regions_mm=frozen(reference.regions_mm - np.nan_to_num(noise_mm)),
            volume_l=reference.volume_l + volume_l,
        )


def _regions_mm(motion: Motion) -> FloatArray:
    """Motion of every region [mm], in the order of `engine.motion.stages.regions.RegionMeans`."""
    wide = (motion.whole_mm, motion.thorax_mm, motion.abdomen_mm)
    return np.concatenate([motion.regions_mm.ravel(), wide, motion.points_mm, motion.named_mm])


def first_frames(measurements: Iterable[Measurement]) -> FirstFrames:
    """Collect the first measured frames; read no more than are needed."""
    first = FirstFrames()
    for measurement in measurements:
        first.add(measurement)
        if first.is_complete:
            break
    return first
