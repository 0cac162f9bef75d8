"""Undo the sensor's quantisation: from whole millimetres back to the depths its steps stand for.

A structured-light sensor measures in steps of 1/z and writes whole millimetres: at 850 mm steps of 2.1 mm come out as
2, 2, 2, .., 3. Over the few steps of a breath that is a gain error, which no averaging removes. The steps follow
``z = 1 / (a + b n)`` for whole n, so the depths that occur at all in a picture give a and b, without any calibration;
each is then replaced by the depth its step stands for, hardly more than a millimetre away. A sensor of which every
millimetre occurs, or whose depths follow no such rule, is left alone.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import DepthImage, FloatArray, frozen

DEPTH_VALUES = 1 << 16
# Where a patient may be: beyond it steps grow so wide that the next wrong one would do.
NEAREST_MM, FARTHEST_MM = 450, 1400
MIN_LEVELS = 40
# Steps narrower than this hardly show in whole millimetres, and hardly matter.
MIN_STEP_MM = 1.2
MIN_AGREEMENT = 0.95
# Whole millimetres lie half of one off at most, or a whole one where they are cut off; and the fit has its error.
AGREEING_MM = 0.65
MAX_CORRECTION_MM = 1.2
MIN_OCCURRENCES = 2
SEARCHED = (0.85, 1.1)
SPACINGS = 600
REFINEMENTS = 4
_LEVELS_MM = np.arange(DEPTH_VALUES, dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthSteps:
    """The steps of a sensor: ``1 / z = offset_per_mm + step_per_mm * n`` [1/mm] for whole n, read as whole mm.

    Attributes
    ----------
    rounding_mm
        Mean depth minus reading: 0.5 for a sensor that truncates, 0 for one that rounds.
    agreement
        Share of the depths that occurred and agree with these steps after rounding.
    """

    offset_per_mm: float
    step_per_mm: float
    rounding_mm: float
    agreement: float

    def depth_mm(self, reading_mm: FloatArray) -> FloatArray:
        """Depth of the step nearest to readings [mm], same shape."""
        step = np.rint((1.0 / (reading_mm + self.rounding_mm) - self.offset_per_mm) / self.step_per_mm)
        return np.asarray(1.0 / (self.offset_per_mm + self.step_per_mm * step))


def count_readings(depth_mm: DepthImage) -> npt.NDArray[np.int64]:
    """How often each depth occurs in a picture, shape (65536,)."""
    counts = cv2.calcHist([depth_mm], [0], None, [DEPTH_VALUES], [0, DEPTH_VALUES])
    return np.asarray(counts, dtype=np.int64).ravel()


def find_steps(occurrences: npt.NDArray[np.int64]) -> DepthSteps | None:
    """Find the sensor's steps in the counts of :func:`count_readings`; None where there are none.

    Some ten pictures of a room are enough: a level that never occurred has no effect, a wrong one lowers the
    agreement slightly.
    """
    levels = NEAREST_MM + np.flatnonzero(occurrences[NEAREST_MM : FARTHEST_MM + 1] >= MIN_OCCURRENCES)
    if len(levels) < MIN_LEVELS:
        return None
    found = [_fit_steps(levels.astype(np.float64), rounding_mm) for rounding_mm in (0.5, 0.0)]
    best = max((steps for steps in found if steps is not None), key=lambda steps: steps.agreement, default=None)
    return best if best is not None and best.agreement >= MIN_AGREEMENT else None


def depth_table_mm(steps: DepthSteps | None) -> FloatArray:
    """Depth [mm] of each of the 65536 readings, float32; NaN for 0, which is "no reading"."""
    table = _LEVELS_MM.copy()
    if steps is not None:
        span = slice(NEAREST_MM, FARTHEST_MM + 1)
        depth = steps.depth_mm(table[span].astype(np.float64))
        table[span] = np.where(np.abs(depth - table[span]) <= MAX_CORRECTION_MM, depth, table[span])
    table[0] = np.nan
    return frozen(table)


def _fit_steps(levels_mm: FloatArray, rounding_mm: float) -> DepthSteps | None:
    """Find the spacing at which the levels stand in step, then fit the line through all of them.

    Nearer than where a step is `MIN_STEP_MM` every millimetre occurs: those levels fit any steps, and would blur them.
    """
    guess = float(np.median(-np.diff(1.0 / (levels_mm + rounding_mm))))
    if guess * float(np.median(levels_mm)) ** 2 < MIN_STEP_MM:
        return None
    levels_mm = levels_mm[guess * np.square(levels_mm) >= MIN_STEP_MM]
    if len(levels_mm) < MIN_LEVELS:
        return None
    inverse = 1.0 / (levels_mm + rounding_mm)
    guess = float(np.median(-np.diff(inverse)))
    # Whole turns of a clock with one step a turn: at the right step all levels point the same way.
    spacings = guess * np.linspace(*SEARCHED, SPACINGS)
    pointers = np.exp(2j * np.pi * inverse / spacings[:, None]).mean(axis=1)
    best = int(np.abs(pointers).argmax())
    step = float(spacings[best])
    offset = step * float(np.angle(pointers[best])) / (2.0 * np.pi)
    for _ in range(REFINEMENTS):
        step, offset = np.polyfit(np.rint((inverse - offset) / step), inverse, 1).tolist()
    predicted = 1.0 / (offset + step * np.rint((inverse - offset) / step)) - rounding_mm
    agreement = float(np.mean(np.abs(predicted - levels_mm) < AGREEING_MM))
    return DepthSteps(offset_per_mm=offset, step_per_mm=step, rounding_mm=rounding_mm, agreement=agreement)
