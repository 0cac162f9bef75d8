"""Principal components of depth frames with gaps (article, section 4.3.2, equations 1 to 5)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.core.errors import ModelError
from engine.core.frames import BoolArray, FloatArray
from engine.core.sentences import say

# A component counts if its variance is this many times that of noise (ADR 0049): others add more noise than motion.
MIN_OVER_NOISE = 2.3
# What a body does at most: no breathing was seen with more than four.
WAYS_TO_MOVE = 6
MAX_FILLINGS = 8
FILLED_CHANGE = 0.003
CELL_PX = 10


def principal_components(
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
    blocks = Blocks(known, max(CELL_PX // stride_px, 1))
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


class Blocks:
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
