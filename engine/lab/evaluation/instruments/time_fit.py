"""Resamples a series at other times by local least-squares parabolas.

Colour pictures are taken at other times than depth frames. A parabola through a quarter of a second of them follows
breathing and heartbeat, and halves the noise of a single picture.
"""

import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, FloatArray

REACH_US = 120_000
MAX_STEP_US = 250_000
MIN_SAMPLES = 3
_SAME_US = 1_000
_UNIT_US = 1e5

Times = npt.NDArray[np.int64]


def fit_at(times_us: Times, values: FloatArray, query_us: Times) -> FloatArray:
    """Resample series at other times.

    Parameters
    ----------
    times_us
        Increasing times of the samples [us], shape (m,).
    values
        Samples, shape (m, p, c); the c channels of one series are NaN together.
    query_us
        Times to resample at [us], shape (n,).

    Returns
    -------
    FloatArray
        Values, shape (n, p, c); NaN where fewer than three samples are near, or none before or none after.
    """
    empty = np.full((len(query_us), *values.shape[1:]), np.nan)
    if len(times_us) < MIN_SAMPLES or len(query_us) == 0:
        return empty
    period_us = float(np.median(np.diff(times_us)))
    # For slow cameras: include a sample on each side of the nearest one.
    reach_us = max(REACH_US, min(1.6 * period_us, MAX_STEP_US))
    around = _around(times_us, query_us, int(reach_us / period_us) + 2)
    away_us = (times_us[around] - query_us[:, None]).astype(np.float64)
    sample = values[around]
    is_near = (np.abs(away_us) <= reach_us)[..., None] & np.isfinite(sample).all(axis=-1) & _is_first(around)[..., None]
    found, is_held = _parabola(away_us / _UNIT_US, np.where(is_near[..., None], sample, 0.0), is_near)
    is_held &= (is_near & (away_us <= _SAME_US)[..., None]).any(axis=1)
    is_held &= (is_near & (away_us >= -_SAME_US)[..., None]).any(axis=1)
    return np.where(is_held[..., None], found, np.nan)


def _around(times_us: Times, query_us: Times, half: int) -> npt.NDArray[np.intp]:
    """Return the indices of the samples around each time, shape (n, 2 half + 1); repeated at the ends."""
    middle = np.searchsorted(times_us, query_us)[:, None] + np.arange(-half, half + 1)
    return np.asarray(np.clip(middle, 0, len(times_us) - 1))


def _is_first(around: npt.NDArray[np.intp]) -> BoolArray:
    """Mark the first occurrence of each index in a row, same shape."""
    is_first = np.ones(around.shape, dtype=np.bool_)
    is_first[:, 1:] = np.diff(around, axis=1) > 0
    return is_first


def _parabola(at: FloatArray, sample: FloatArray, is_near: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Fit a parabola to the near samples, evaluated at 0: (n, k), (n, k, p, c), (n, k, p) to (n, p, c), (n, p)."""
    weight = is_near.astype(np.float64)
    powers = np.stack([at**power for power in range(5)])
    moments = np.einsum("qnk,nkp->npq", powers, weight)
    sides = np.einsum("qnk,nkp,nkpc->npqc", powers[:3], weight, sample)
    system = moments[..., np.add.outer(np.arange(3), np.arange(3))]
    is_held = (weight.sum(axis=1) >= MIN_SAMPLES) & (np.linalg.det(system) > 1e-9)
    system = np.where(is_held[..., None, None], system, np.eye(3))
    return np.asarray(np.linalg.solve(system, sides)[..., 0, :]), is_held
