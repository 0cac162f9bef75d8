"""Finds the sensor's error that is common to all pixels (`engine.core.locking_curve`) in the frames of a training.

At each point the depth is linear in the few scores of the breath, but the error is not: it swings with the phase of the
disparity, and a breath sweeps a part of that. What is left of the readings without everything linear in the scores is
therefore fitted by what is left of the swings, over all points at once: tens of thousands of points with one curve
resolve hundredths of a millimetre. No smoothness of the body is assumed. While the error is not known, the components
take over a part of it, so the fit is repeated on corrected frames.

An error that differs from place to place adds to a common curve by chance. How far is measured by the scatter of
patches of the region, and a curve counts in so far as it stands above that.
"""

import numpy as np

from engine.core.frames import BoolArray, FloatArray
from engine.core.locking_curve import HARMONICS, LARGEST_PX, LockingCurve, corrected, swings_mm
from engine.motion.learning.principal_components import principal_components
from engine.motion.learning.shape_smoothing import DISPARITY_MM_PX, smooth_shapes

STRIDE_PX = 4
PATCH_PX = 16
"""Side of the patches: more than the matching's window."""
ROUNDS = 4
MOST_FRAMES = 450
"""Of a longer training every second, third, ... frame: more resolve the curve no better than the body lets them."""
CHANCE, CERTAIN = 5.0, 7.0
"""Standard errors at which a curve begins to count, and counts in full; windows of 7 by 21 px reach 3.8 by chance."""
LARGEST_RESIDUAL_MM = 8.0
LEAST_PERIODS = 1.5
"""Least range of the region's depths in periods: on a flatter one motion that components lack looks like a curve."""


def find_locking(
    depth_mm: FloatArray, valid: BoolArray, known: BoolArray, stride_px: int, components: int
) -> LockingCurve | None:
    """Return the curve of a training's sensor; None where there is none above chance.

    Parameters
    ----------
    depth_mm, valid, known, stride_px, components
        As in `engine.motion.learning.fitting.fit`: frames on the thinned grid, shape (n, rows, columns).
    """
    every = (slice(None, None, max(STRIDE_PX // stride_px, 1)),) * 2
    chosen = (slice(None, None, -(-len(depth_mm) // MOST_FRAMES)), *every)
    raw, seen, known = np.ascontiguousarray(depth_mm[chosen]), np.ascontiguousarray(valid[chosen]), known[every]
    low_mm, high_mm = np.percentile(raw[:, known][seen[:, known]], [5.0, 95.0])
    if DISPARITY_MM_PX / low_mm - DISPARITY_MM_PX / high_mm < LEAST_PERIODS:
        return None
    patches = _patches(known, PATCH_PX // STRIDE_PX)
    factors, shares, frames = np.zeros(2 * HARMONICS), np.zeros(HARMONICS), raw
    for number in range(ROUNDS):
        found, errors = _fitted(frames, seen, known, components, patches)
        if number == 0:
            shares = np.clip((errors - CHANCE) / (CERTAIN - CHANCE), 0.0, 1.0)
        if not shares.any():
            return None
        factors = factors + np.tile(shares, 2) * found
        if not np.abs(factors).max() <= LARGEST_PX:
            return None  # no sensor's matching: something else moves with the phase
        curve = LockingCurve(
            pixels_mm=DISPARITY_MM_PX,
            cosine_px=tuple(factors[:HARMONICS].tolist()),
            sine_px=tuple(factors[HARMONICS:].tolist()),
        )
        frames = corrected(raw, curve.table_mm())
    return curve


def _fitted(
    depth_mm: FloatArray, valid: BoolArray, known: BoolArray, components: int, patches: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fit the curve once; return its factors, shape (2 HARMONICS,), and each harmonic's size in standard errors."""
    mean, centred, scores, _ = principal_components(depth_mm, valid, known, STRIDE_PX, components)
    shapes = smooth_shapes(centred, scores, known, STRIDE_PX, mean)
    points, inside = known.ravel(), valid.reshape(len(valid), -1)[:, known.ravel()]
    smooth_mm = mean[known] + scores @ np.stack([shape.surface.ravel()[points] for shape in shapes])
    left_mm = np.clip(_nonlinear(centred[:, points], scores), -LARGEST_RESIDUAL_MM, LARGEST_RESIDUAL_MM) * inside
    swings = [_nonlinear(one, scores) * inside for one in swings_mm(smooth_mm, DISPARITY_MM_PX)]
    gram = np.array([[patches @ (one * other).sum(axis=0) for other in swings] for one in swings]).transpose(2, 0, 1)
    right = np.array([patches @ (one * left_mm).sum(axis=0) for one in swings]).T
    inverse = np.linalg.pinv(gram.sum(axis=0))
    factors = inverse @ right.sum(axis=0)
    chance = right - gram @ factors  # of each patch; their sum is zero
    covariance = inverse @ (chance.T @ chance) @ inverse
    errors = [
        _standard_errors(factors[one::HARMONICS], covariance[one::HARMONICS, one::HARMONICS])
        for one in range(HARMONICS)
    ]
    return factors, np.array(errors)


def _standard_errors(pair: FloatArray, covariance: FloatArray) -> float:
    """Size of a cosine and a sine in standard errors of one of them."""
    return float(np.sqrt(pair @ np.linalg.pinv(covariance) @ pair / 2.0))


def _nonlinear(values: FloatArray, scores: FloatArray) -> FloatArray:
    """Values in time, shape (n, m), without their mean and what is linear in the orthonormal scores, shape (n, k)."""
    values = values - values.mean(axis=0)
    return np.asarray(values - scores @ (scores.T @ values), dtype=np.float32)


def _patches(known: BoolArray, side: int) -> FloatArray:
    """Which known point lies in which patch: ones, shape (patches, known points)."""
    rows, columns = (np.arange(size) // side for size in known.shape)
    number = (rows[:, None] * (columns[-1] + 1) + columns)[known]
    return np.asarray(np.arange(number.max() + 1)[:, None] == number, dtype=np.float32)
