"""What this camera's readings mean in millimetres: its steps found in the first frames, its scale corrected.

The table stays as it is found for as long as frames come: a model learned with one table is not used with another.
"""

import numpy as np

from engine.calibration import DepthCorrection
from engine.frames import DepthImage, FloatArray, frozen
from engine.stages.quantisation import DEPTH_VALUES, DepthSteps, count_readings, depth_table_mm, find_steps

# So many pictures of a room show the levels that matter.
FRAMES_LOOKED_AT = 12


class DepthTable:
    """Looks at the first frames, then knows what readings mean."""

    def __init__(self, correction: DepthCorrection | None) -> None:
        self._correction = correction
        self._frames = 0
        self._counts = np.zeros(DEPTH_VALUES, dtype=np.int64)
        self.steps: DepthSteps | None = None
        self.table_mm = self._corrected(depth_table_mm(None))

    @property
    def is_settled(self) -> bool:
        """Whether enough frames were looked at."""
        return self._frames >= FRAMES_LOOKED_AT

    def look_at(self, depth_mm: DepthImage) -> None:
        """Count one picture's readings; with the last of them the table is made."""
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
