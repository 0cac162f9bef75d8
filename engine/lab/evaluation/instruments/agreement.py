"""Agreement of two instruments: the figures of the article's Table 2 for one point."""

from dataclasses import dataclass

import numpy as np

from engine.core.frames import FloatArray

MIN_FRAMES = 30


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
