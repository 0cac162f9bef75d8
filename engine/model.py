"""The motion model: a patient's mean surface and the few ways it moves (article, sections 4.3.2 and 4.4.1).

Everything is on the region's grid, 350 rows by 200 columns, depth in mm along the depth camera's axis. Equation (3) of
the article prints a frame where the *mean* frame is subtracted; equation (5)'s eigenvectors are n long and have to be
mapped back through the data to become components.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from engine.errors import ModelError
from engine.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, frozen
from engine.provenance import Provenance

MIN_FRAMES = 20
KNOWN_SHARE = 0.5
SMOOTHING_PX = 4.0
FILL_ITERATIONS = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionModel:
    """Mean surface, principal components and spectrum of one patient's breathing.

    Attributes
    ----------
    mean_mm
        Mean depth [mm], shape (350, 200), float32; filled in smoothly where ``known`` is false.
    components
        Orthonormal over the grid, shape (k, 350, 200), float32. Sign: a growing first coefficient is inhale, so each
        component's mean is negative; a retrained model does not flip.
    eigenvalues_mm2
        Variance of each principal component, descending [mm^2, summed over the grid], shape (n,).
    known
        Where at least half of the training frames had a reading, shape (350, 200).
    cycles
        Complete breathing cycles among the training frames.
    calibration_sha256
        The calibration the frames were aligned with.
    surface_mm
        Mean of the surface's vertices at the region's nodes, in the depth camera's frame [mm], shape (nodes, 3); None
        where nobody noted them. It tells a later fraction how far the patient lies from here.
    provenance
        How good the training was, and where the model comes from.
    """

    mean_mm: FloatArray
    components: FloatArray
    eigenvalues_mm2: FloatArray
    known: BoolArray
    training_frames: int
    cycles: int
    seconds: float
    calibration_sha256: str
    surface_mm: FloatArray | None = None
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        """Check shapes and finiteness once, where the model is made."""
        grid = (ROI_ROWS, ROI_COLUMNS)
        if self.mean_mm.shape != grid or self.known.shape != grid or self.components.shape[1:] != grid:
            msg = f"a model lives on the {ROI_ROWS} x {ROI_COLUMNS} grid, not {self.mean_mm.shape}"
            raise ModelError(msg)
        if not (np.isfinite(self.mean_mm).all() and np.isfinite(self.components).all()):
            msg = "a model must be finite everywhere"
            raise ModelError(msg)
        surface = self.surface_mm
        if surface is not None and (surface.shape[1:] != (3,) or not np.isfinite(surface).all()):
            msg = f"a model's surface is made of finite points, not {surface.shape}"
            raise ModelError(msg)
        for array in (self.mean_mm, self.components, self.eigenvalues_mm2, self.known, self.surface_mm):
            if array is not None:
                frozen(array)

    @property
    def spectrum(self) -> FloatArray:
        """Share of the variance each principal component explains, descending, sums to 1 (article, Fig. 5)."""
        total = float(self.eigenvalues_mm2.sum())
        return self.eigenvalues_mm2 / total if total > 0.0 else np.zeros_like(self.eigenvalues_mm2)

    def components_for(self, share: float) -> int:
        """How many components explain ``share`` of the variance: the article's 98 % rule."""
        return int(np.searchsorted(np.cumsum(self.spectrum), share) + 1)

    def reconstruct(self, beta: FloatArray) -> FloatArray:
        """Equation (7): the surface that coefficients mean [mm], shape (350, 200)."""
        return self.mean_mm + np.tensordot(beta, self.components, axes=1)


def fit(
    depth_mm: FloatArray,
    valid: BoolArray,
    *,
    components: int,
    cycles: int,
    seconds: float,
    calibration_sha256: str,
) -> MotionModel:
    """Learn a model from training frames (equations 1 to 5).

    Parameters
    ----------
    depth_mm, valid
        Preprocessed frames, shape (n, 350, 200), float32 and bool. Remaining holes are filled with what the
        components say of them, from frames that saw the pixel.

    Raises
    ------
    ModelError
        Too few frames, too little of the region seen, or nothing moved.
    """
    n = len(depth_mm)
    if n < MIN_FRAMES:
        msg = f"{n} training frames: at least {MIN_FRAMES} are needed"
        raise ModelError(msg)
    known = valid.mean(axis=0) >= KNOWN_SHARE
    if known.mean() < KNOWN_SHARE:
        msg = f"only {known.mean():.0%} of the region was seen during training: at least {KNOWN_SHARE:.0%} is needed"
        raise ModelError(msg)
    data = np.ascontiguousarray(depth_mm[:, known])
    seen = valid[:, known]
    mean, weights, eigenvalues = _principal_components(data, seen, components)
    surface = np.zeros(known.shape, dtype=np.float32)
    surface[known] = mean
    shapes = [_smooth(_scatter(row, known), known) for row in weights]
    return MotionModel(
        mean_mm=_fill_unknown(surface, known),
        components=_orthonormal(np.array(shapes, dtype=np.float32)),
        eigenvalues_mm2=eigenvalues,
        known=known,
        training_frames=n,
        cycles=cycles,
        seconds=seconds,
        calibration_sha256=calibration_sha256,
    )


def _principal_components(data: FloatArray, seen: BoolArray, k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """PCA of (n, m) data with gaps: fill with the mean, then with what the components say, and repeat."""
    gaps = ~seen
    has_gaps = bool(gaps.any())
    if has_gaps:
        counts = seen.sum(axis=0)
        mean = np.where(seen, data, 0.0).sum(axis=0, dtype=np.float64) / counts
        data = np.where(seen, data, mean.astype(np.float32))
    for last in (not has_gaps, *[False] * (FILL_ITERATIONS - 1), True):
        mean = data.mean(axis=0, dtype=np.float64).astype(np.float32)
        centred = data - mean
        covariance = (centred @ centred.T).astype(np.float64) / (len(data) - 1)
        eigenvalues, vectors = np.linalg.eigh(covariance)
        eigenvalues, vectors = np.maximum(eigenvalues[::-1], 0.0), vectors[:, ::-1]
        if eigenvalues[0] <= 1e-6 * data.shape[1]:
            msg = "nothing moved during training: there is no breathing to learn"
            raise ModelError(msg)
        weights = vectors[:, :k].T.astype(np.float32) @ centred
        weights /= np.maximum(np.linalg.norm(weights, axis=1, keepdims=True), 1e-9)
        if last:
            break
        reconstructed = mean + (centred @ weights.T) @ weights
        data = np.where(gaps, reconstructed, data)
    return mean, weights, eigenvalues


def _scatter(values: FloatArray, known: BoolArray) -> FloatArray:
    surface = np.zeros(known.shape, dtype=np.float32)
    surface[known] = values
    return surface


def _smooth(surface: FloatArray, known: BoolArray) -> FloatArray:
    """Gaussian smoothing over known pixels only: a chest moves smoothly, the sensor's noise does not."""
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), SMOOTHING_PX)
    blurred = cv2.GaussianBlur(np.where(known, surface, np.float32(0.0)), (0, 0), SMOOTHING_PX)
    smooth = np.where(weight > 1e-3, blurred / np.maximum(weight, 1e-3), np.float32(0.0)).astype(np.float32)
    return _fill_unknown(smooth, weight > 1e-3)


def _fill_unknown(surface: FloatArray, known: BoolArray) -> FloatArray:
    """Carry a surface smoothly into what was never seen, from near to far; cells there are not reported."""
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


def _orthonormal(shapes: FloatArray) -> FloatArray:
    """Orthonormalise smoothed components in their order and fix the sign: inhale is positive."""
    flat = shapes.reshape(len(shapes), -1).astype(np.float64)
    q, r = np.linalg.qr(flat.T)
    basis = q.T * np.where(np.diag(r) < 0.0, -1.0, 1.0)[:, None]
    basis *= np.where(basis.sum(axis=1) > 0.0, -1.0, 1.0)[:, None]
    return basis.reshape(shapes.shape).astype(np.float32)
