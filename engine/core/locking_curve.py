"""The error of a depth sensor that swings with the sub-pixel phase of its disparity and is the same at every pixel.

The matching of structured light and of stereo prefers certain sub-pixel positions (*pixel locking*). Over the depth
range of a breath this error is a wrong gain: most of what averaging over time cannot remove.
"""

from dataclasses import dataclass

import numpy as np

from engine.core.errors import InvalidValueError
from engine.core.frames import FloatArray

HARMONICS = 2
LARGEST_PX = 0.1
"""Largest factor: with more than some 0.15 px readings would fall while the depth grows, which no matching does."""
TABLE_MM = (300.0, 1700.0)
TABLE_STEP_MM = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class LockingCurve:
    """A curve over the phase of the disparity ``pixels_mm / depth``.

    Attributes
    ----------
    pixels_mm
        Focal length times baseline [px mm].
    cosine_px, sine_px
        Factors of the cosine and the sine of one, two, ... phases [px of disparity].
    """

    pixels_mm: float
    cosine_px: tuple[float, ...]
    sine_px: tuple[float, ...]

    def __post_init__(self) -> None:
        """Raise InvalidValueError for another number of factors, or one that is not finite or beyond `LARGEST_PX`."""
        if len(self.cosine_px) != HARMONICS or len(self.sine_px) != HARMONICS or not self.pixels_mm > 0.0:
            raise InvalidValueError("locking", self, f"{HARMONICS} pairs of factors over a disparity")
        if not all(abs(one) <= LARGEST_PX for one in (*self.cosine_px, *self.sine_px)):
            raise InvalidValueError("locking", self, f"factors of at most {LARGEST_PX:g} px")

    def error_mm(self, depth_mm: FloatArray) -> FloatArray:
        """Depth that is read minus the true depth [mm], same shape; ``depth_mm`` is either of them."""
        factors = np.array([self.cosine_px, self.sine_px]).ravel()
        return np.asarray(np.tensordot(factors, swings_mm(depth_mm, self.pixels_mm), axes=1))

    def table_mm(self) -> FloatArray:
        """Return the error at every `TABLE_STEP_MM` of `TABLE_MM`, float32, for `corrected`."""
        return np.asarray(self.error_mm(np.arange(*TABLE_MM, TABLE_STEP_MM)), dtype=np.float32)


def swings_mm(depth_mm: FloatArray, pixels_mm: float) -> FloatArray:
    """Errors that a pixel of each factor makes [mm]: cosines, then sines, shape (2 HARMONICS, ...)."""
    pixel_mm = np.square(depth_mm) / np.float32(pixels_mm)
    phase = np.float32(2.0 * np.pi * pixels_mm) / depth_mm
    phases = [np.float32(number) * phase for number in range(1, HARMONICS + 1)]
    return np.stack([pixel_mm * wave(one) for wave in (np.cos, np.sin) for one in phases])


def corrected(depth_mm: FloatArray, table_mm: FloatArray) -> FloatArray:
    """Take the error off readings [mm], same shape; beyond the table its nearest error. No reading (NaN) stays so."""
    place = (depth_mm - np.float32(TABLE_MM[0])) * np.float32(1.0 / TABLE_STEP_MM)
    inside = np.where(place > 0.0, np.minimum(place, np.float32(len(table_mm) - 1)), np.float32(0.0))
    return np.asarray(depth_mm - table_mm[inside.astype(np.int32)])
