"""Fits a motion model to training frames (article, section 4.3.2, equations 1 to 5).

Three deviations from the article, with their effect measured in docs/adr/0004: components are smoothed as far as noise
and the sensor's fixed errors require (:mod:`engine.motion.learning.shape_smoothing`), since a chest moves smoothly and
noise in a component reduces the measured motion; frames are not filtered by the bilateral filter, which had no benefit;
and the sensor's noise is estimated, which later sets the weight of the readings in the projection.
"""

import numpy as np

from engine.core.errors import ModelError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray
from engine.core.motion_model import MotionModel
from engine.motion.learning.shape_smoothing import fill_unknown, scatter, smooth_shapes

MIN_FRAMES = 20
KNOWN_SHARE = 0.5
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
        Number of components to keep.
    cycles, seconds
        Breathing cycles in the set, and its length [s]; stored with the model.

    Raises
    ------
    ModelError
        There are too few frames, too little of the region has readings, or there is no motion.
    """
    n = len(depth_mm)
    if n < MIN_FRAMES:
        msg = f"{n} training frames: at least {MIN_FRAMES} are needed"
        raise ModelError(msg)
    known = valid.mean(axis=0) >= KNOWN_SHARE
    if known.mean() < KNOWN_SHARE:
        msg = f"only {known.mean():.0%} of the region had readings in training: at least {KNOWN_SHARE:.0%} are needed"
        raise ModelError(msg)
    stride_px = -(-ROI_ROWS // depth_mm.shape[1])
    data, seen = depth_mm[:, known], valid[:, known]
    mean, centred, scores, eigenvalues = _principal_components(data, seen, known, stride_px, components)
    shapes = smooth_shapes(centred, scores, known, stride_px, float(mean.mean()))
    noise_mm = _noise_mm(centred - scores @ (scores.T @ centred), known, stride_px)
    return MotionModel(
        mean_mm=_on_grid(fill_unknown(scatter(mean, known), known), stride_px),
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
    data: FloatArray, seen: BoolArray, known: BoolArray, stride_px: int, k: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """PCA of (n, m) data with gaps: fill with the mean, then with the reconstruction, and repeat.

    The n x n covariance of the article is computed from means over cells of 10 px: motion is smooth and noise is not,
    so the spectrum is that of the motion.

    Returns the mean (m,), the centred data (n, m), the frames' scores as orthonormal columns (n, k), and all
    eigenvalues (n,), summed over the m points.
    """
    gaps = ~seen
    has_gaps = bool(gaps.any())
    mean = data.sum(axis=0, where=seen, dtype=np.float64) / seen.sum(axis=0)
    centred = (data - mean.astype(np.float32)) * seen
    largest = 0.0
    for _ in range(MAX_FILLINGS if has_gaps else 1):
        cells = _cell_means(centred, known, stride_px)
        covariance = (cells @ cells.T).astype(np.float64) / (len(data) - 1)
        eigenvalues, vectors = np.linalg.eigh(covariance)
        eigenvalues, scores = np.maximum(eigenvalues[::-1], 0.0), vectors[:, ::-1][:, :k].astype(np.float32)
        if eigenvalues[0] <= 1e-6 * data.shape[1]:
            msg = "there was no motion during training: no breathing to learn"
            raise ModelError(msg)
        if not has_gaps or eigenvalues[0] - largest < FILLED_CHANGE * eigenvalues[0]:
            break
        largest = eigenvalues[0]
        np.copyto(centred, scores @ (scores.T @ centred), where=gaps)
        shift = centred.mean(axis=0)
        centred -= shift
        mean += shift
    return mean.astype(np.float32), centred, scores, eigenvalues


def _cell_means(centred: FloatArray, known: BoolArray, stride_px: int) -> FloatArray:
    """Average points, shape (n, m), over cells, shape (n, cells), each scaled by the root of its number of points."""
    side = max(CELL_PX // stride_px, 1)
    rows, columns = (np.arange(size) // side for size in known.shape)
    cell = (rows[:, None] * (columns[-1] + 1) + columns)[known]
    order = np.argsort(cell, kind="stable")
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    counts = np.diff(np.append(first, len(order)))
    return np.asarray(np.add.reduceat(centred[:, order], first, axis=1) / np.sqrt(counts, dtype=np.float32))


def _noise_mm(unexplained: FloatArray, known: BoolArray, stride_px: int) -> float:
    """Estimate the sensor's noise: the mean of a square of n x n grid pixels has this standard deviation over n [mm].

    From differences of consecutive frames, since the slow part of the residual is not noise.
    """
    side = NOISE_SQUARE_PX // stride_px
    rows, columns = (size // side for size in known.shape)
    inside = known[: rows * side, : columns * side].reshape(rows, side, columns, side).all(axis=(1, 3))
    which = np.full(known.shape, -1)
    label = np.where(inside, np.arange(rows * columns).reshape(rows, columns), -1)
    which[: rows * side, : columns * side] = np.repeat(np.repeat(label, side, axis=0), side, axis=1)
    steps = np.diff(unexplained, axis=0)
    means = [steps[:, which[known] == square].mean(axis=1) for square in label[inside]]
    if not means:
        return MIN_NOISE_MM * NOISE_SQUARE_PX
    variance = float(np.median(np.square(means))) / _MEDIAN_SQUARE / 2.0
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
