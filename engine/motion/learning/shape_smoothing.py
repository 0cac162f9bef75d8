"""Smooths the components of a motion model as strongly as their errors require.

A raw component is the true shape, noise, and an error of the sensor that is fixed to the pixel and varies with depth
(*pixel locking*): over a breath it is a wrong local gain, the same in every breath, so two halves of the frames agree
on it. It has a period of one pixel of disparity, hence also a curvature: a reading depends on the square of the
breathing signal, which noise and smooth motion do not at this scale. The curvature's energy measures the error.

A component is split into bands of spatial scale. Each keeps the share of its energy that noise and locking do not
explain (Wiener's filter); what is wider than all bands is kept. The kernel subtracts its own bias (twice-applied
Gaussian), so it attenuates structures of the body less than a Gaussian of equal noise.
"""

import itertools
from typing import NamedTuple

import cv2
import numpy as np

from engine.core.frames import BoolArray, FloatArray

FINEST_PX = 4.0
WIDTHS_PX = (12.0, 20.0, 32.0)
# Energy of an error that is correlated over the matching window, in each band, relative to the first.
LOCKING_BANDS = np.array([1.0, 0.27, 0.13])
# Focal length times baseline of structured-light cameras: a pixel of disparity is z^2 / this.
DISPARITY_MM_PX = 43_000.0
# Chance and the curvature of the body bring the ratio of curvature to noise to 1.34 at most; locking to 1.47 and more.
CERTAINLY_NOISE, CERTAINLY_LOCKING = 1.3, 1.5
# Too much smoothing costs less than too little: of 1.3, 2, 3 and 5 the last two are alike, and where locking is strong
# they leave 0.13 mm of 0.21; where it is weak they cost up to 0.003 mm (ADR 0057).
CAUTION = 3.0
POINTS = 64
MOVING_SHARE = 0.4


class ShapeErrors(NamedTuple):
    """Likely energy of the errors of raw components [mm^2 summed over the points].

    Attributes
    ----------
    noise, locking
        In each band and in what is wider, shape (k, bands + 1).
    locking_ratio
        Energy of the curvature over that of noise in the finest band; 1 without locking.
    """

    noise: FloatArray
    locking: FloatArray
    locking_ratio: float


class SmoothShape(NamedTuple):
    """A smoothed component on the grid, and the error that is left of it: root mean square over the points.

    Both are in mm for a score of one.
    """

    surface: FloatArray
    error_mm: float


class Bands:
    """Splits surfaces on the thinned grid into bands of spatial scale.

    Parameters
    ----------
    known
        Known points of the thinned grid, shape (rows, columns).
    stride_px
        Its stride.
    """

    def __init__(self, known: BoolArray, stride_px: int) -> None:
        self._known, self._stride_px = known, stride_px

    def split(self, values: FloatArray) -> tuple[list[FloatArray], FloatArray]:
        """Return the bands, finest first, and the rest that is wider, each of the grid's shape, of (m,) values."""
        surface = fill_unknown(scatter(values, self._known), self._known)
        levels = [gaussian(surface, FINEST_PX / self._stride_px)]
        levels += [self._twice(surface, width_px / self._stride_px) for width_px in WIDTHS_PX]
        return [fine - wide for fine, wide in itertools.pairwise(levels)], levels[-1]

    def energy(self, values: FloatArray, at: BoolArray | slice = slice(None)) -> FloatArray:
        """Return the energy of (m,) values in each band and in the rest, at all or some points, shape (bands + 1,)."""
        fine, wide = self.split(values)
        return np.array([float(np.square(band[self._known][at]).sum()) for band in (*fine, wide)])

    def _twice(self, surface: FloatArray, sigma: float) -> FloatArray:
        once = gaussian(surface, sigma)
        return np.asarray(once + gaussian(np.where(self._known, surface - once, np.float32(0.0)), sigma))


def smooth_shapes(
    centred: FloatArray, scores: FloatArray, known: BoolArray, stride_px: int, mean: FloatArray
) -> list[SmoothShape]:
    """Map scores back to components and smooth these.

    Parameters
    ----------
    centred
        Training frames without their mean [mm], shape (n, points of the thinned grid).
    scores
        Scores of the frames, orthonormal columns, shape (n, k), the largest component first.
    known
        Known points of the thinned grid.
    mean
        Mean surface [mm], on the thinned grid.
    """
    depth_mm = float(mean[known].mean())
    bands = Bands(known, stride_px)
    sums = weighted_sums(centred, scores, known)
    parts = [bands.split(shape) for shape in sums.even + sums.odd]
    errors = estimate_errors(sums, scores, [wide[known] for _, wide in parts], bands, depth_mm)
    shapes = []
    for (fine, wide), noise, locking in zip(parts, errors.noise, errors.locking, strict=True):
        total, likely = np.array([float(np.square(band[known]).sum()) for band in fine]), noise + locking
        kept = kept_shares(total, (noise + CAUTION * locking)[:-1])
        lost = (1.0 - kept) ** 2 @ np.maximum(total - likely[:-1], 0.0)
        left_mm = np.sqrt((kept**2 @ likely[:-1] + lost + likely[-1]) / np.count_nonzero(known))
        shapes.append(SmoothShape(np.asarray(wide + np.tensordot(kept, np.stack(fine), axes=1)), float(left_mm)))
    return shapes


def kept_shares(total: FloatArray, error: FloatArray) -> FloatArray:
    """Return the share of each band that is kept, of its energy and that of its errors, shape (bands,): Wiener's."""
    return np.clip(1.0 - error / np.maximum(total, 1e-9), 0.0, 1.0).astype(np.float32)


class WeightedSums(NamedTuple):
    """Sums of the frames at the known points: even and odd frames by their scores, (k, m), all by the curvature, (m,).

    All at once, since the frames are far larger than the caches.
    """

    even: FloatArray
    odd: FloatArray
    bent: FloatArray


def weighted_sums(centred: FloatArray, scores: FloatArray, known: BoolArray) -> WeightedSums:
    """Return the sums of centred frames, shape (n, points), weighted by scores, shape (n, k)."""
    k, is_even = scores.shape[1], (np.arange(len(scores)) % 2 == 0)[:, None]
    weights = np.column_stack([scores * is_even, scores * ~is_even, _curvature(scores)])
    sums = (weights.T @ centred)[:, known.ravel()]
    return WeightedSums(even=sums[:k], odd=sums[k : 2 * k], bent=sums[2 * k])


def estimate_errors(
    sums: WeightedSums, scores: FloatArray, wide: list[FloatArray], bands: Bands, depth_mm: float
) -> ShapeErrors:
    """Estimate the errors of raw components; ``wide`` are smooth versions of these, k of shape (m,)."""
    # Half the difference of two halves of the frames has the noise of the whole.
    noise = np.array([bands.energy(one - other) for one, other in zip(sums.even, sums.odd, strict=True)])
    # Where the most motion is, locking is bent the most against the same noise.
    moving = np.abs(wide[0]) >= np.quantile(np.abs(wide[0]), 1.0 - MOVING_SHARE)
    bents = bands.energy(sums.bent, moving)
    unbents = bands.energy(sums.even[0] - sums.odd[0], moving)
    ratio = float(bents[0] / max(unbents[0], 1e-9))
    certainty = float(np.clip((ratio - CERTAINLY_NOISE) / (CERTAINLY_LOCKING - CERTAINLY_NOISE), 0.0, 1.0))
    gains = _gains(scores, _curvature(scores), wide, moving, depth_mm)
    energy = certainty * (bents - unbents)[0] * LOCKING_BANDS
    locking = np.maximum([*energy, (bents - unbents)[-1]], 0.0) * gains[:, None]
    return ShapeErrors(noise=noise, locking=locking, locking_ratio=ratio)


def _curvature(scores: FloatArray) -> FloatArray:
    """Square of the first score, orthogonal to a constant and to all scores, of unit length, shape (n,)."""
    first = scores[:, 0].astype(np.float64)
    linear = np.column_stack([np.ones(len(first)), scores])
    square = first**2 / float(np.square(first).mean())
    square -= linear @ np.linalg.lstsq(linear, square, rcond=None)[0]
    return np.asarray(square / max(float(np.linalg.norm(square)), 1e-9), dtype=np.float32)


def _gains(
    scores: FloatArray, curvature: FloatArray, wide: list[FloatArray], moving: BoolArray, depth_mm: float
) -> FloatArray:
    """Energy that locking adds to each component for a unit of energy in the curvature of the moving points, (k,)."""
    order = np.argsort(np.abs(wide[0]))
    points = order[np.linspace(0, len(order) - 1, POINTS).astype(np.intp)]
    motion_mm = scores @ np.stack(wide)[:, points]
    period_mm = depth_mm**2 / DISPARITY_MM_PX
    error = np.exp(2j * np.pi / period_mm * motion_mm)  # both phases of the sinusoid
    error -= error.mean(axis=0)
    straight = np.square(np.abs(scores.T @ error)).sum(axis=1)
    bent = float(np.square(np.abs(curvature @ error[:, moving[points]])).sum())
    return np.asarray(straight / max(bent, 1e-9))


def scatter(values: FloatArray, known: BoolArray) -> FloatArray:
    """Arrange values of the known points on the grid, zero elsewhere."""
    surface = np.zeros(known.shape, dtype=np.float32)
    surface[known] = values
    return surface


def gaussian(surface: FloatArray, sigma: float) -> FloatArray:
    """Apply Gaussian smoothing to a filled surface; slopes are preserved at the edges."""
    # Padding by point reflection continues a slope; reflection alone would flatten it.
    margin = int(3.0 * sigma) + 1
    padded = np.pad(surface, margin, mode="reflect", reflect_type="odd")
    inner = slice(margin, -margin)
    return np.ascontiguousarray(cv2.GaussianBlur(padded, (0, 0), sigma)[inner, inner], dtype=np.float32)


def fill_unknown(surface: FloatArray, known: BoolArray) -> FloatArray:
    """Extrapolate a surface smoothly into unknown points, from near to far; unknown cells are not reported."""
    filled, have = surface.astype(np.float32).copy(), known.copy()
    sigma = 3.0
    while not have.all():
        weight = cv2.GaussianBlur(have.astype(np.float32), (0, 0), sigma)
        blurred = cv2.GaussianBlur(np.where(have, filled, np.float32(0.0)), (0, 0), sigma)
        reached = ~have & (weight > 0.05)
        filled[reached] = blurred[reached] / weight[reached]
        have |= reached
        sigma = min(2.0 * sigma, 200.0)
    return filled
