"""A series sampled at its own times, read at others: through a short piece of parabola, least squares.

Colour pictures are taken at other times than depth frames. A parabola through a quarter of a second of them follows a
breath, and a heart, and halves the noise that one picture has.
"""

import numpy as np
import numpy.typing as npt

from engine.frames import BoolArray, FloatArray

REACH_US = 120_000
MAX_STEP_US = 250_000
LEAST_SAMPLES = 3
_SAME_US = 1_000
_UNIT_US = 1e5

Times = npt.NDArray[np.int64]


def fit_at(times_us: Times, values: FloatArray, wanted_us: Times) -> FloatArray:
    """Read series at other times.

    Parameters
    ----------
    times_us
        Increasing times of the samples [us], shape (m,).
    values
        Samples, shape (m, p, c); the c channels of one series are NaN together.
    wanted_us
        Where to read [us], shape (n,).

    Returns
    -------
    FloatArray
        Shape (n, p, c); NaN where there are not three samples near, or none before or none after.
    """
    empty = np.full((len(wanted_us), *values.shape[1:]), np.nan)
    if len(times_us) < LEAST_SAMPLES or len(wanted_us) == 0:
        return empty
    period_us = float(np.median(np.diff(times_us)))
    # Slow cameras: a sample on each side beside the nearest one.
    reach_us = max(REACH_US, min(1.6 * period_us, MAX_STEP_US))
    around = _around(times_us, wanted_us, int(reach_us / period_us) + 2)
    away_us = (times_us[around] - wanted_us[:, None]).astype(np.float64)
    sample = values[around]
    is_near = (np.abs(away_us) <= reach_us)[..., None] & np.isfinite(sample).all(axis=-1) & _once(around)[..., None]
    found, is_held = _parabola(away_us / _UNIT_US, np.where(is_near[..., None], sample, 0.0), is_near)
    is_held &= (is_near & (away_us <= _SAME_US)[..., None]).any(axis=1)
    is_held &= (is_near & (away_us >= -_SAME_US)[..., None]).any(axis=1)
    return np.where(is_held[..., None], found, np.nan)


def _around(times_us: Times, wanted_us: Times, half: int) -> npt.NDArray[np.intp]:
    """Give indices of the samples around each wanted time, shape (n, 2 half + 1); some twice at the ends."""
    middle = np.searchsorted(times_us, wanted_us)[:, None] + np.arange(-half, half + 1)
    return np.asarray(np.clip(middle, 0, len(times_us) - 1))


def _once(around: npt.NDArray[np.intp]) -> BoolArray:
    """Mark the first of each index in a row."""
    is_first = np.ones(around.shape, dtype=np.bool_)
    is_first[:, 1:] = np.diff(around, axis=1) > 0
    return is_first


def _parabola(at: FloatArray, sample: FloatArray, is_near: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Fit a parabola to what is near and read it at 0: shapes (n, k), (n, k, p, c), (n, k, p) to (n, p, c), (n, p)."""
    weight = is_near.astype(np.float64)
    powers = np.stack([at**power for power in range(5)])
    moments = np.einsum("qnk,nkp->npq", powers, weight)
    sides = np.einsum("qnk,nkp,nkpc->npqc", powers[:3], weight, sample)
    system = moments[..., np.add.outer(np.arange(3), np.arange(3))]
    is_held = (weight.sum(axis=1) >= LEAST_SAMPLES) & (np.linalg.det(system) > 1e-9)
    system = np.where(is_held[..., None, None], system, np.eye(3))
    return np.asarray(np.linalg.solve(system, sides)[..., 0, :]), is_held
