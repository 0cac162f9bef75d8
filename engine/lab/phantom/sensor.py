"""A structured-light depth sensor with the errors measured on real recordings.

It works in its own unit, shift: ``depth_cm = m * 120 / (7.5 - m) + 120``, ``m = ((shift - 800) / 4 - 0.375) * zpps``.
In shift, noise is the same at any depth: white in time, correlated over a few pixels, uncorrelated beyond; a fixed
pattern adds to it, and rare jumps in small clusters, most of them at edges. Readings are rounded to whole shifts, then
to whole mm. A unit's scale has an error of some per cent and drifts while it warms up. Noise and patterns are those of
one of the :mod:`engine.lab.phantom.sensor_models`.

Noise comes from a bank of fields made once: each frame adds two of them with random offsets, flips and signs, which is
many times faster than new fields; no two frames use the same pair.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, DepthImage, FloatArray
from engine.lab.phantom.body import Map, blur
from engine.lab.phantom.builds import Build
from engine.lab.phantom.holes import Holes
from engine.lab.phantom.rig import HEIGHT_PX, STEPS_A_MM, WIDTH_PX, ZERO_PLANE_PX_SIZE
from engine.lab.phantom.sensor_models import STEPS_A_PX, USUAL, WINDOW_PX, SensorModel, find_sensor

SHIFTS = 2048
NEAREST_MM, FARTHEST_MM = 350, 9500
JUMPS_A_FRAME = 200.0
JUMP_PX = 3
WARM_UP_SHARE = 0.0012
WARM_UP_S = 700.0
_BANK = 8
_MARGIN_PX = 128
# The shift of infinite depth.
_FAR_SHIFT = 4.0 * (7.5 / ZERO_PLANE_PX_SIZE + 0.375) + 800.0


def depth_table_mm() -> npt.NDArray[np.uint16]:
    """Depth of each of the 2048 shifts [mm], truncated, shape (2048,); 0 where the sensor has no reading."""
    m = ((np.arange(SHIFTS) - 800.0) / 4.0 - 0.375) * ZERO_PLANE_PX_SIZE
    with np.errstate(divide="ignore"):
        depth_mm = np.trunc(10.0 * (m * 120.0 / (7.5 - m) + 120.0))
    is_read = (depth_mm >= NEAREST_MM) & (depth_mm <= FARTHEST_MM) & (m < 7.5)
    return np.where(is_read, depth_mm, 0).astype(np.uint16)


def shift_of(depth_mm: FloatArray) -> FloatArray:
    """Shift of a reading of ``depth_mm`` [mm], not rounded, same shape."""
    return np.asarray(_FAR_SHIFT - STEPS_A_MM / depth_mm)


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """One camera unit: scale and offset of its true depth against its reading; it starts cold."""

    scale: float
    offset_mm: float

    @classmethod
    def of(cls, build: Build) -> "Unit":
        """Return the unit that a volunteer was recorded with."""
        return cls(scale=build.depth_scale, offset_mm=build.depth_offset_mm)

    def reading_scale(self, time_s: float) -> tuple[float, float]:
        """Return (a, b) of ``reading = a * z + b`` at this time after switching on."""
        warm = 1.0 + WARM_UP_SHARE * float(np.exp(-time_s / WARM_UP_S))
        return warm / self.scale, -warm * self.offset_mm / self.scale


class Sensor:
    """Converts true depth to the readings of one unit.

    Parameters
    ----------
    model
        Name of the sensor model, one of `SENSORS`.
    """

    def __init__(self, unit: Unit, seed: int, model: str = USUAL) -> None:
        self._unit = unit
        self._seed = seed
        self._model = find_sensor(model)
        self._table = depth_table_mm()
        rng = np.random.default_rng((seed, 3))
        self._bank = [_correlated_field(rng, self._model) for _ in range(_BANK)]
        pattern = blur(rng.standard_normal((HEIGHT_PX, WIDTH_PX), dtype=np.float32), self._model.pattern_blur_px)
        self._pattern = (pattern * (self._model.pattern_shifts / pattern.std()) + _FAR_SHIFT).astype(np.float32)
        self._locking = _locking_fields((seed, 7), self._model.locking_shifts)

    def read(
        self, depth_mm: Map, holes: Holes, *, frame: int, time_s: float, blocked: BoolArray | None = None
    ) -> DepthImage:
        """Return the readings of one frame [mm], uint16, shape (480, 640); 0 is no reading.

        Parameters
        ----------
        depth_mm
            True depth, shape (480, 640).
        holes
            The holes of this pose.
        frame
            Ordinal of the frame; its noise depends only on the seed and this number.
        time_s
            Time since the start [s].
        blocked
            Further pixels without a reading in this frame, shape (480, 640).
        """
        rng = np.random.default_rng((self._seed, 4, frame))
        scale, offset = self._unit.reading_scale(time_s)
        shift = depth_mm * np.float32(scale)
        shift += np.float32(offset)
        np.divide(np.float32(-STEPS_A_MM), shift, out=shift)
        shift += self._pattern
        if self._locking is not None:
            phase = shift * np.float32(2.0 * np.pi / STEPS_A_PX)
            shift += self._locking[0] * np.cos(phase) + self._locking[1] * np.sin(phase)
        shift += self._draw(rng) * np.float32(self._model.noise_shifts)
        self._jump(shift, holes, rng)
        index = np.clip(np.rint(shift, out=shift), 0, SHIFTS - 1, out=shift).astype(np.uint16)
        reading = self._table[index]
        missing = self._draw(rng) < holes.level
        if blocked is not None:
            missing |= blocked
        reading[missing] = 0
        return reading

    def _draw(self, rng: np.random.Generator) -> Map:
        """Return one correlated field of unit variance."""
        first, second = rng.choice(_BANK, 2, replace=False)
        top, left, top2, left2 = rng.integers(0, _MARGIN_PX + 1, 4)
        sign = rng.choice(np.array([-1.0, 1.0]), 2) * np.sqrt(0.5)
        one = self._bank[first][top : top + HEIGHT_PX, left : left + WIDTH_PX]
        two = self._bank[second][top2 : top2 + HEIGHT_PX, left2 : left2 + WIDTH_PX]
        total = cv2.addWeighted(one, float(sign[0]), two[::-1, ::-1], float(sign[1]), 0.0)
        return np.asarray(total, dtype=np.float32)

    def _jump(self, shift: Map, holes: Holes, rng: np.random.Generator) -> None:
        count = int(rng.poisson(JUMPS_A_FRAME))
        rows, columns = rng.integers(0, HEIGHT_PX, 4 * count), rng.integers(0, WIDTH_PX, 4 * count)
        # Keep all candidates at edges and few elsewhere.
        keep = (rng.random(4 * count) < 0.027) | holes.is_edge[rows, columns]
        sizes = rng.uniform(9.0, 18.0, 4 * count) * rng.choice(np.array([-1.0, 1.0]), 4 * count)
        for row, column, size in zip(rows[keep], columns[keep], sizes[keep], strict=True):
            shift[row : row + JUMP_PX, column : column + JUMP_PX] += np.float32(size)


def _locking_fields(seed: tuple[int, int], locking_shifts: float) -> tuple[Map, Map] | None:
    """Factors of the phase's cosine and sine at each pixel [shifts], each of shape (H, W); None without locking."""
    if locking_shifts == 0.0:
        return None
    rng = np.random.default_rng(seed)
    fields = [rng.standard_normal((HEIGHT_PX, WIDTH_PX), dtype=np.float32) for _ in range(2)]
    cosine, sine = (cv2.blur(one, (WINDOW_PX, WINDOW_PX)) for one in fields)
    scale = np.float32(locking_shifts / np.sqrt(np.mean(cosine**2 + sine**2)))
    return np.asarray(cosine * scale, dtype=np.float32), np.asarray(sine * scale, dtype=np.float32)


def _correlated_field(rng: np.random.Generator, model: SensorModel) -> Map:
    """Noise of unit variance: white noise plus correlated parts."""
    size = (HEIGHT_PX + _MARGIN_PX, WIDTH_PX + _MARGIN_PX)
    total = np.zeros(size, np.float32)
    for share, blur_px in model.noise_parts:
        field = rng.standard_normal(size, dtype=np.float32)
        field = blur(field, blur_px) if blur_px else field
        total += field * np.float32(np.sqrt(share) / field.std())
    return total
