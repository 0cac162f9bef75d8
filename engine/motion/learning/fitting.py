"""Fits a motion model to training frames (article, section 4.3.2, equations 1 to 5).

Four deviations from the article, with their effect measured in docs/adr/0004 and 0049: as many components are kept as
are above noise, in place of three; components are smoothed as far as noise and the sensor's fixed errors require
(:mod:`engine.motion.learning.shape_smoothing`), since a chest moves smoothly and noise in a component reduces the
measured motion; frames are not filtered by the bilateral filter, which had no benefit; and the sensor's noise is
estimated, which later sets the weight of the readings in the projection.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.core.errors import ModelError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray
from engine.core.motion_model import MotionModel
from engine.core.sentences import say
from engine.motion.learning.shape_smoothing import fill_unknown, smooth_shapes

MIN_FRAMES = 20
KNOWN_SHARE = 0.5
# A component counts if its variance is this many times that of noise (ADR 0049): others add more noise than motion.
MIN_OVER_NOISE = 2.3
# What a body does at most: no breathing was seen with more than four.
WAYS_TO_MOVE = 6
MAX_FILLINGS = 8
FILLED_CHANGE = 0.003
CELL_PX = 10
# Side of the squares for the noise estimate: well above the noise's correlation, well below the motion's structures.
NOISE_SQUARE_PX = 24
MIN_NOISE_MM = 0.5
# Median of a squared normal value, over its variance.
_MEDIAN_SQUARE = 0.4549


def fit(
    depth_mm: FloatArray,
    valid: BoolArray,
    *,
    components: int,
    cycles: int,
    seconds: float,
    calibration_sha256: str,
) -> MotionModel:
    """Fit a model to training frames in order of time.

    Parameters
    ----------
    depth_mm, valid
        Frames on the grid, shape (n, 350, 200) or thinned by a stride, float32 [mm] and bool. Holes are filled from the
        components, iteratively.
    components
        Largest number of components; those that noise explains are left out.
    cycles, seconds
        Breathing cycles in the set, and its length [s]; stored with the model.

    Raises
    ------
    ModelError
        There are too few frames, too little of the region has readings, or there is no motion.
    """
    n = len(depth_mm)
    if n < MIN_FRAMES:
        msg = say("{n} training frames: at least {min_frames} are needed", n=n, min_frames=MIN_FRAMES)
        raise ModelError(msg)
    counts = np.add.reduce(valid.view(np.uint8), axis=0, dtype=np.int64)
    known = counts >= KNOWN_SHARE * n
    if known.mean() < KNOWN_SHARE:
        msg = say(
            "only {known:.0%} of the region had readings in training: at least {known_share:.0%} are needed",
            known=known.mean(),
            known_share=KNOWN_SHARE,
        )
        raise ModelError(msg)
    stride_px = -(-ROI_ROWS // depth_mm.shape[1])
    mean, centred, scores, eigenvalues = _principal_components(depth_mm, valid, known, stride_px, components)
    shapes = smooth_shapes(centred, scores, known, stride_px, float(mean[known].mean()))
    noise_mm = _noise_mm(centred, scores, known, stride_px)
    return MotionModel(
        mean_mm=_on_grid(fill_unknown(mean, known), stride_px),
        components=_orthonormal(np.array([_on_grid(shape, stride_px) for shape in shapes])),
        eigenvalues_mm2=eigenvalues * stride_px**2,
        known=np.repeat(np.repeat(known, stride_px, axis=0), stride_px, axis=1)[:ROI_ROWS, :ROI_COLUMNS].copy(),
        noise_mm=noise_mm,
        training_frames=n,
        cycles=cycles,
        seconds=seconds,
        calibration_sha256=calibration_sha256,
    )


def _principal_components(
    depth_mm: FloatArray, valid: BoolArray, known: BoolArray, stride_px: int, most: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """PCA of frames with gaps: fill with the mean, then with the reconstruction, and repeat.

    The n x n covariance of the article is computed from means over cells of 10 px: motion is smooth and noise is not,
    so the spectrum is that of the motion.

    Returns the mean (rows, columns), the centred frames (n, points), both zero at unknown points, the frames' scores as
    orthonormal columns, at most ``most``, and all eigenvalues (n,), summed over the points.
    """
    n = len(depth_mm)
    mean, centred, gaps = _centred(depth_mm, valid, known)
    blocks = _Blocks(known, max(CELL_PX // stride_px, 1))
    largest = 0.0
    for _ in range(MAX_FILLINGS if gaps.points.size else 1):
        cells = blocks.sums(centred) / np.sqrt(blocks.counts, dtype=np.float32)
        covariance = (cells @ cells.T).astype(np.float64) / (n - 1)
        eigenvalues, vectors = np.linalg.eigh(covariance)
        eigenvalues = np.maximum(eigenvalues[::-1], 0.0)
        k = _above_noise(eigenvalues, most)
        scores = np.ascontiguousarray(vectors[:, ::-1][:, :k], dtype=np.float32)
        if eigenvalues[0] <= 1e-6 * np.count_nonzero(known):
            msg = say("there was no motion during training: no breathing to learn")
            raise ModelError(msg)
        if not gaps.points.size or eigenvalues[0] - largest < FILLED_CHANGE * eigenvalues[0]:
            break
        largest = eigenvalues[0]
        mean.ravel()[gaps.points] += gaps.fill(centred, scores)
    return mean.astype(np.float32), centred, scores, eigenvalues


def _above_noise(eigenvalues: FloatArray, most: int) -> int:
    """Count the components that are motion: two in quiet breathing, four in an isovolume manoeuvre; one at least.

    What lies behind all of a body's ways to move, and behind what may be kept, is noise.
    """
    noise = eigenvalues[min(max(most, WAYS_TO_MOVE), len(eigenvalues) - 1)]
    return max(int(np.count_nonzero(eigenvalues[:most] > MIN_OVER_NOISE * noise)), 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Gaps:
    """Points that some frames did not see, shape (g,), and which frames, shape (n, g)."""

    points: npt.NDArray[np.intp]
    is_missing: BoolArray

    def fill(self, centred: FloatArray, scores: FloatArray) -> FloatArray:
        """Fill the gaps with what the scores reconstruct; return by how much the means have moved, shape (g,)."""
        values = centred[:, self.points]
        np.copyto(values, scores @ (scores.T @ values), where=self.is_missing)
        shift = values.mean(axis=0)
        centred[:, self.points] = values - shift
        return np.asarray(shift)


def _centred(depth_mm: FloatArray, valid: BoolArray, known: BoolArray) -> tuple[FloatArray, FloatArray, _Gaps]:
    """Return the mean of the valid readings, shape (rows, columns), the frames without it, (n, points), and the gaps.

    Unknown points and gaps are zero. Sums are of differences from the first readings, which 32 bit resolve.
    """
    n, shape = len(depth_mm), known.shape
    flat, seen = depth_mm.reshape(n, -1), valid.reshape(n, -1)
    first = np.where(known.ravel(), flat[seen.argmax(axis=0), np.arange(flat.shape[1])], np.float32(0.0))
    centred = flat - first
    points = np.flatnonzero(known.ravel() & ~seen.all(axis=0))
    counts = np.full(flat.shape[1], float(n))
    counts[points] = np.count_nonzero(seen[:, points], axis=0)
    centred[:, ~known.ravel()] = 0.0
    centred[:, points] *= seen[:, points]
    shift = (np.ones(n, dtype=np.float32) @ centred) / counts
    centred -= shift.astype(np.float32)
    is_missing = ~seen[:, points]
    centred[:, points] *= ~is_missing
    return (first + shift).reshape(shape), centred, _Gaps(points=points, is_missing=is_missing)


class _Blocks:
    """Sums the known points of frames over square blocks; a product with ones along each axis does it fastest."""

    def __init__(self, known: BoolArray, side: int) -> None:
        self._shape = known.shape
        rows, columns = (np.arange(size) // side for size in known.shape)
        self._rows = (np.arange(rows[-1] + 1)[:, None] == rows).astype(np.float32)
        self._columns = (columns[:, None] == np.arange(columns[-1] + 1)).astype(np.float32)
        counts = (self._rows @ known.astype(np.float32) @ self._columns).ravel()
        self._is_known = counts > 0.0
        self.counts = counts[self._is_known]

    def sums(self, values: FloatArray) -> FloatArray:
        """Return the sums of values, shape (n, points), in the blocks with known points, shape (n, blocks)."""
        along = values.reshape(-1, self._shape[1]) @ self._columns
        sums = self._rows @ along.reshape(len(values), self._shape[0], -1)
        return np.ascontiguousarray(sums.reshape(len(values), -1)[:, self._is_known])


def _noise_mm(centred: FloatArray, scores: FloatArray, known: BoolArray, stride_px: int) -> float:
    """Estimate the sensor's noise: the mean of a square of n x n grid pixels has this standard deviation over n [mm].

    From differences of consecutive frames of what the scores do not explain, since the slow part is not noise. Only
    wholly known squares count.
    """
    side = NOISE_SQUARE_PX // stride_px
    blocks = _Blocks(known, side)
    is_whole = blocks.counts == side * side
    if not is_whole.any():
        return MIN_NOISE_MM * NOISE_SQUARE_PX
    means = blocks.sums(centred)[:, is_whole] / np.float32(side * side)
    steps = np.diff(means - scores @ (scores.T @ means), axis=0)
    variance = float(np.median(np.square(steps))) / _MEDIAN_SQUARE / 2.0
    return max(float(np.sqrt(variance)) * NOISE_SQUARE_PX, MIN_NOISE_MM)


def _on_grid(surface: FloatArray, stride_px: int) -> FloatArray:
    """Interpolate a thinned surface to the full grid, shape (350, 200); linear extrapolation beyond the last sample."""
    if stride_px == 1:
        return surface
    rows, columns = (
        _linear_weights(size, thin, stride_px)
        for size, thin in zip((ROI_ROWS, ROI_COLUMNS), surface.shape, strict=True)
    )
    return np.asarray(rows @ surface @ columns.T)


def _linear_weights(size: int, thin: int, stride_px: int) -> FloatArray:
    at = np.arange(size) / stride_px
    left = np.minimum(at.astype(np.intp), thin - 2)
    weights = np.zeros((size, thin), dtype=np.float32)
    weights[np.arange(size), left] = 1.0 - (at - left)
    weights[np.arange(size), left + 1] = at - left
    return weights


def _orthonormal(shapes: FloatArray) -> FloatArray:
    """Orthonormalise smoothed components in their order and fix the sign: inhale is positive."""
    flat = shapes.reshape(len(shapes), -1).astype(np.float64)
    q, r = np.linalg.qr(flat.T)
    basis = q.T * np.where(np.diag(r) < 0.0, -1.0, 1.0)[:, None]
    basis *= np.where(basis.sum(axis=1) > 0.0, -1.0, 1.0)[:, None]
    return basis.reshape(shapes.shape).astype(np.float32)
