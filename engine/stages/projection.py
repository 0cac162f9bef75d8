"""Explain a frame with the motion model: valid pixels only, robustly (article, section 4.4.1, equation 6).

Equation (6) lets a hole enter as minus the mean, an error of 850 mm in that pixel. Here the coefficients are the
maximum a posteriori solution of a small linear system over the pixels that the sensor saw, re-weighted so that a hand,
a sheet or a cable has no say. Beside the components stand low-order cosines with a zero-mean prior: free breathing does
not teach how a breath hold or a shifted patient looks, and a smooth misfit is motion, not noise.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from engine.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, Projection, RoiDepth, frozen
from engine.model import MotionModel

STRIDE = 2  # every fourth pixel is as accurate as every pixel: the sensor's noise is correlated over about nine
COSINE_ROWS = 6
COSINE_COLUMNS = 4
COSINE_SPREAD_MM = 3.0
NOISE_MM = 2.5  # of a pixel, blown up for its correlation with its neighbours
OUTLIER_MM = 6.0
MAX_REWEIGHTINGS = 12
CONVERGED_MM = 0.003
CHECK_CELL = 25
CHECK_MIN_SHARE = 0.4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Basis:
    """A model prepared for projection: components, then cosines, each with its prior.

    Attributes
    ----------
    modes
        Components and cosines on the full grid, shape (k + e, 350, 200), float32.
    sampled_modes, sampled_mean_mm, sampled_known
        The same on every second row and column, flattened, shapes (k + e, s), (s,), (s,).
    precision
        Prior precision of each coefficient [1/mm^2], shape (k + e,).
    reach
        Largest motion that a unit of each coefficient makes anywhere [mm], shape (k + e,).
    known_normal
        Normal matrix of all known pixels, prior included, shape (k + e, k + e), float64.
    """

    components: int
    modes: FloatArray
    sampled_modes: FloatArray
    sampled_mean_mm: FloatArray
    sampled_known: BoolArray
    precision: FloatArray
    reach: FloatArray
    known_normal: FloatArray

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.modes, self.sampled_modes, self.sampled_mean_mm, self.sampled_known, self.known_normal):
            frozen(array)


def prepare_basis(model: MotionModel) -> Basis:
    """Put the model's components and the smooth correction side by side."""
    k = len(model.components)
    cosines, spread_mm = _cosines()
    modes = np.concatenate([model.components, cosines])
    # A breath hold may be several times the training's excursion: the components' prior only keeps the system solvable.
    learned_mm = 10.0 * np.sqrt(np.maximum(model.eigenvalues_mm2[:k], 1.0))
    known = np.ascontiguousarray(model.known[::STRIDE, ::STRIDE]).ravel()
    sampled = np.ascontiguousarray(modes[:, ::STRIDE, ::STRIDE].reshape(len(modes), -1))
    sampled *= known
    precision = 1.0 / np.concatenate([learned_mm, spread_mm]) ** 2
    return Basis(
        components=k,
        modes=modes,
        sampled_modes=sampled,
        sampled_mean_mm=np.ascontiguousarray(model.mean_mm[::STRIDE, ::STRIDE]).ravel(),
        sampled_known=known,
        precision=precision,
        reach=np.abs(sampled).max(axis=1).astype(np.float64),
        known_normal=_gram(sampled) + np.diag(precision),
    )


def project(basis: Basis, roi: RoiDepth, start: FloatArray | None) -> Projection | None:
    """Find the coefficients of one frame.

    Parameters
    ----------
    start
        Coefficients of the frame before, shape (k + e,), where there is one: a hand that just came in is then an
        outlier from its first frame.

    Returns
    -------
    Projection | None
        None when nothing of the region was seen.
    """
    usable = roi.valid[::STRIDE, ::STRIDE].ravel() & basis.sampled_known
    seen = float(usable.sum())
    if seen < 0.02 * usable.size:
        return None
    difference = roi.depth_mm[::STRIDE, ::STRIDE].ravel() - basis.sampled_mean_mm
    inside = usable.astype(np.float32)
    difference *= inside
    factor = cho_factor(_normal(basis, usable))
    coefficients = _nearest_start(basis, difference, inside, [start, _first_solution(basis, factor, difference)])
    for _ in range(MAX_REWEIGHTINGS):
        misfit = (difference - coefficients.astype(np.float32) @ basis.sampled_modes) * inside
        weights = _tukey(misfit)
        # One normal matrix serves every reweighting: with weights of at most one each step still lowers the cost.
        gradient = _right_side(basis, weights * misfit) - basis.precision * coefficients
        step = cho_solve(factor, gradient)
        coefficients = coefficients + step
        if np.abs(step * basis.reach).max() < CONVERGED_MM:
            break
    misfit = (difference - coefficients.astype(np.float32) @ basis.sampled_modes) * inside
    return Projection(
        beta=coefficients[: basis.components].copy(),
        coefficients=coefficients,
        residual_mm=_largest_cell_misfit(misfit, inside),
        valid_share=seen / max(float(basis.sampled_known.sum()), 1.0),
        inlier_share=float((np.abs(misfit[usable]) < 0.9 * OUTLIER_MM).mean()),
    )


def _gram(modes: FloatArray) -> FloatArray:
    return (modes @ modes.T).astype(np.float64) / NOISE_MM**2


def _normal(basis: Basis, usable: BoolArray) -> FloatArray:
    """Sum the normal matrix of the usable pixels: by taking away those that are not, since they are few."""
    missing = basis.sampled_known & ~usable
    if 2 * int(missing.sum()) > usable.size:
        return _gram(basis.sampled_modes[:, usable]) + np.diag(basis.precision)
    return basis.known_normal - _gram(basis.sampled_modes[:, missing])


def _right_side(basis: Basis, values: FloatArray) -> FloatArray:
    return (basis.sampled_modes @ values).astype(np.float64) / NOISE_MM**2


def _nearest_start(
    basis: Basis, difference: FloatArray, inside: FloatArray, starts: list[FloatArray | None]
) -> FloatArray:
    """Choose the start that explains most pixels: the last frame's, or every pixel's if the patient moved far."""
    given = [start for start in starts if start is not None]

    def explained(start: FloatArray) -> float:
        return float(_tukey((difference - start.astype(np.float32) @ basis.sampled_modes) * inside).sum())

    return max(given, key=explained)


def _first_solution(basis: Basis, factor: tuple[FloatArray, bool], difference: FloatArray) -> FloatArray:
    return np.asarray(cho_solve(factor, _right_side(basis, difference)), dtype=np.float64)


def _tukey(misfit: FloatArray) -> FloatArray:
    ratio = np.minimum(np.abs(misfit) / np.float32(OUTLIER_MM), np.float32(1.0))
    one_less: FloatArray = np.float32(1.0) - ratio * ratio
    return one_less * one_less


def _cell_sums() -> tuple[FloatArray, FloatArray]:
    rows = np.arange(0, ROI_ROWS, STRIDE) // CHECK_CELL
    columns = np.arange(0, ROI_COLUMNS, STRIDE) // CHECK_CELL
    return (
        (rows == np.arange(rows.max() + 1)[:, None]).astype(np.float32),
        (columns[:, None] == np.arange(columns.max() + 1)).astype(np.float32),
    )


_SUM_ROWS, _SUM_COLUMNS = _cell_sums()
_CELL_PIXELS = _SUM_ROWS.sum(axis=1)[:, None] * _SUM_COLUMNS.sum(axis=0)


def _largest_cell_misfit(misfit: FloatArray, inside: FloatArray) -> float:
    shape = (_SUM_ROWS.shape[1], _SUM_COLUMNS.shape[0])
    sums = _SUM_ROWS @ (misfit * inside).reshape(shape) @ _SUM_COLUMNS
    counts = _SUM_ROWS @ inside.reshape(shape) @ _SUM_COLUMNS
    judged = counts >= CHECK_MIN_SHARE * _CELL_PIXELS
    if not judged.any():
        return float("nan")
    return float(np.abs(sums[judged] / counts[judged]).max())


def _cosines() -> tuple[FloatArray, FloatArray]:
    """Low-order cosines (piston first) and their prior spread [mm], shapes (e, 350, 200) and (e,)."""
    rows = (np.arange(ROI_ROWS) + 0.5) / ROI_ROWS
    columns = (np.arange(ROI_COLUMNS) + 0.5) / ROI_COLUMNS
    shapes, spread = [], []
    for i in range(COSINE_ROWS):
        for j in range(COSINE_COLUMNS):
            shapes.append(np.outer(np.cos(np.pi * i * rows), np.cos(np.pi * j * columns)))
            spread.append(COSINE_SPREAD_MM / (1.0 + i * i + j * j))
    return np.array(shapes, dtype=np.float32), np.array(spread)
