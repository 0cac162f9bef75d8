"""Converts a camera's readings to depth [mm]: quantisation steps from the first frames, scale from the calibration.

The table is fixed after the first frames: a model learned with one table is not used with another.
"""

import numpy as np

from engine.calibration.camera_calibration import DepthCorrection
from engine.calibration.quantisation import DEPTH_VALUES, DepthSteps, count_readings, depth_table_mm, find_steps
from engine.core.frames import DepthImage, FloatArray, frozen

# This many pictures contain the depth levels of the region.
COUNTED_FRAMES = 12


class DepthTable:
    """Estimates the depth of each reading from the first frames."""

    def __init__(self, correction: DepthCorrection | None) -> None:
        self._correction = correction
        self._frames = 0
        self._counts = np.zeros(DEPTH_VALUES, dtype=np.int64)
        self.steps: DepthSteps | None = None
        self.table_mm = self._corrected(depth_table_mm(None))

    @property
    def is_settled(self) -> bool:
        """Whether enough frames were counted, so that the table is final."""
        return self._frames >= COUNTED_FRAMES

    def count(self, depth_mm: DepthImage) -> None:
        """Count one picture's readings; the last one completes the table."""
        self._counts += count_readings(depth_mm)
        self._frames += 1
        if self.is_settled:
            self.steps = find_steps(self._counts)
            self.table_mm = self._corrected(depth_table_mm(self.steps))

    def _corrected(self, table_mm: FloatArray) -> FloatArray:
        correction = self._correction
        if correction is None:
            return table_mm
        return frozen((table_mm * correction.scale + correction.offset_mm).astype(np.float32))
