"""The camera's noise now, frame to frame, by the means of the region's cells.

A model's noise is that of its training: a second projector or the sun may have been there, and be gone. Tolerances that
follow noise take the smaller of both. Noise far below the training's is a sign too: of a training in bad light, or of a
filter of the driver or the camera that averages pictures in time and so shows old ones.

Second differences are taken, as breathing hardly shows in them, and their median over the cells, as a hand or a cough
moves some cells only.
"""

import math

import numpy as np

from engine.core.compiled import FramePath
from engine.core.frames import FloatArray

WEIGHT, SOON_WEIGHT = 1.0 / 45.0, 1.0 / 6.0
LEAST_FRAMES = 45
MAX_STEP_US = 60_000
"""Frames farther apart are not consecutive."""
SECOND_DIFFERENCE = 6.0
"""Variance of x[i] - 2 x[i-1] + x[i-2] for values of variance 1 without memory."""
MEDIAN_SQUARE = 0.4549
"""Median of the square of a normal value of variance 1."""
FILTERED_SHARE = 0.4
"""Share of the training's noise below which the depth is not that of single pictures any more."""


class PresentNoise:
    """Follows the noise over a second and a half; owned by one thread.

    Parameters
    ----------
    side_px
        Side of a square as large as a cell, in pixels of the region's grid: noise is given as a model's is.
    """

    def __init__(self, side_px: float) -> None:
        self._side_px = side_px
        self._cells: list[FloatArray] = []
        self._last_us = 0
        self._variance_mm2 = self._soon_mm2 = 0.0
        self._frames = 0
        self.noise_mm = math.nan

    def add(self, cells_mm: FloatArray, timestamp_us: int) -> None:
        """Take the means of a frame's cells [mm], shape (cells,); NaN for those not seen."""
        if not 0 < timestamp_us - self._last_us <= MAX_STEP_US:
            self._cells.clear()
        self._last_us = timestamp_us
        self._cells.append(cells_mm)
        if len(self._cells) < 3:
            return
        first, second, third = self._cells
        del self._cells[0]
        median_mm2 = _median_square(first, second, third)
        if math.isnan(median_mm2):
            return
        variance_mm2 = median_mm2 / MEDIAN_SQUARE / SECOND_DIFFERENCE
        self._frames += 1
        self._variance_mm2 += max(WEIGHT, 1.0 / self._frames) * (variance_mm2 - self._variance_mm2)
        self._soon_mm2 += max(SOON_WEIGHT, 1.0 / self._frames) * (variance_mm2 - self._soon_mm2)
        if self._frames >= LEAST_FRAMES:
            self.noise_mm = self._side_px * math.sqrt(self._variance_mm2)

    def counting(self, trained_mm: float) -> float:
        """Return the noise that tolerances count with: the smaller of the training's and the present one [mm]."""
        noise_mm = self.noise_mm
        return noise_mm if noise_mm < trained_mm else trained_mm

    def share_of(self, trained_mm: float) -> float:
        """Return the present noise as a share of the training's; NaN while it is not known."""
        return self.noise_mm / trained_mm if trained_mm > 0.0 else math.nan

    def share_soon(self, trained_mm: float) -> float:
        """Return the same of the last fifth of a second: a filter in time is found before a breath goes on."""
        is_known = self._frames >= LEAST_FRAMES and trained_mm > 0.0
        return self._side_px * math.sqrt(self._soon_mm2) / trained_mm if is_known else math.nan


def _median_square(first_mm: FloatArray, second_mm: FloatArray, third_mm: FloatArray) -> float:
    """Return the median square of the second difference of three frames' cells [mm2]; NaN where none was seen."""
    compiled = FramePath.kernels
    if compiled is not None:
        median_mm2: float = compiled.median_square(first_mm, second_mm, third_mm)
        return median_mm2
    change_mm = third_mm - 2.0 * second_mm + first_mm
    squares = np.square(change_mm[np.isfinite(change_mm)])
    return float(np.median(squares)) if len(squares) else math.nan
