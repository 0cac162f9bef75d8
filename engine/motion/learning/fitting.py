"""Fits a motion model to training frames (article, section 4.3.2, equations 1 to 5).

Five deviations from the article, with their effect measured in docs/adr/0004, 0049 and 0057: an error that the sensor
makes at every pixel alike is taken off (:mod:`engine.motion.learning.locking`); as many components are kept as are
above noise, in place of three; components are smoothed as far as noise and the sensor's fixed errors require
(:mod:`engine.motion.learning.shape_smoothing`), since a chest moves smoothly and noise in a component reduces the
measured motion; frames are not filtered by the bilateral filter, which had no benefit; and the sensor's noise is
estimated, which later sets the weight of the readings in the projection.
"""

import numpy as np

from engine.core.errors import ModelError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray
from engine.core.locking_curve import corrected
from engine.core.motion_model import MotionModel
from engine.core.sentences import say
from engine.motion.learning.locking import find_locking
from engine.motion.learning.principal_components import Blocks, principal_components
from engine.motion.learning.shape_smoothing import fill_unknown, smooth_shapes

MIN_FRAMES = 20
KNOWN_SHARE = 0.5
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
    locking = find_locking(depth_mm, valid, known, stride_px, components)
    if locking is not None:
        table_mm = locking.table_mm()
        depth_mm = np.stack([corrected(frame, table_mm) for frame in depth_mm])  # one by one: little memory
    mean, centred, scores, eigenvalues = principal_components(depth_mm, valid, known, stride_px, components)
    shapes = smooth_shapes(centred, scores, known, stride_px, mean)
    noise_mm = _noise_mm(centred, scores, known, stride_px)
    surfaces = [_on_grid(shape.surface, stride_px) for shape in shapes]
    return MotionModel(
        mean_mm=_on_grid(fill_unknown(mean, known), stride_px),
        components=_orthonormal(np.array(surfaces)),
        shape_errors=tuple(
            shape.error_mm / float(np.linalg.norm(surface)) for shape, surface in zip(shapes, surfaces, strict=True)
        ),
        eigenvalues_mm2=eigenvalues * stride_px**2,
        known=np.repeat(np.repeat(known, stride_px, axis=0), stride_px, axis=1)[:ROI_ROWS, :ROI_COLUMNS].copy(),
        noise_mm=noise_mm,
        locking=locking,
        training_frames=n,
        cycles=cycles,
        seconds=seconds,
        calibration_sha256=calibration_sha256,
    )


def _noise_mm(centred: FloatArray, scores: FloatArray, known: BoolArray, stride_px: int) -> float:
    """Estimate the sensor's noise: the mean of a square of n x n grid pixels has this standard deviation over n [mm].

    From differences of consecutive frames of what the scores do not explain, since the slow part is not noise. Only
    wholly known squares count.
    """
    side = NOISE_SQUARE_PX // stride_px
    blocks = Blocks(known, side)
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
