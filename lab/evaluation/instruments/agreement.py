"""Agreement of two instruments: the figures of the article's Table 2 for one point.

Resamples a series at other times by local least-squares parabolas.

Colour pictures are taken at other times than depth frames. A parabola through a quarter of a second of them follows
breathing and heartbeat, and halves the noise of a single picture.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, FloatArray

MIN_FRAMES = 30
REACH_US = 120_000
MAX_STEP_US = 250_000
MIN_SAMPLES = 3
_SAME_US = 1_000
_UNIT_US = 1e5
Times = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Agreement over the frames in which both instruments measured; None where there are too few of them.

    Attributes
    ----------
    frames
        Number of those frames.
    mean_mm, deviation_mm, largest_mm
        Mean, standard deviation and maximum of the absolute difference (article, equation 9 and Table 2).
    correlation
        Normalised cross-correlation of both motions; None also where one of them is constant.
    """

    frames: int
    mean_mm: float | None = None
    deviation_mm: float | None = None
    largest_mm: float | None = None
    correlation: float | None = None


def agreement(one_mm: FloatArray, other_mm: FloatArray, min_frames: int = MIN_FRAMES) -> Agreement:
    """Compare two motions of the same frames [mm], shape (n,), NaN where not measured."""
    is_both = np.isfinite(one_mm) & np.isfinite(other_mm)
    frames = int(np.count_nonzero(is_both))
    if frames < max(min_frames, 2):
        return Agreement(frames=frames)
    one, other = one_mm[is_both], other_mm[is_both]
    error = np.abs(one - other)
    return Agreement(
        frames=frames,
        mean_mm=float(error.mean()),
        deviation_mm=float(error.std()),
        largest_mm=float(error.max()),
        correlation=correlation(one, other),
    )


def correlation(one: FloatArray, other: FloatArray) -> float | None:
    """Pearson's correlation of two series without gaps; None if one of them is constant."""
    a, b = one - one.mean(), other - other.mean()
    spread = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / spread) if spread > 1e-12 else None


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
