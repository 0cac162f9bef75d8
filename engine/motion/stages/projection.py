"""Explain a frame with the motion model: valid pixels only, robustly (article, section 4.4.1, equation 6).

Equation (6) lets a hole enter as minus the mean, an error of 850 mm in that pixel. Here the coefficients are the
maximum a posteriori solution of a small linear system over the pixels that the sensor saw, re-weighted so that a hand,
a sheet or a cable has no say. Beside the components stand low-order cosines with a zero-mean prior: free breathing does
not teach how a breath hold or a shifted patient looks, and a smooth misfit is motion, not noise.

The frame itself determines the weight of the cosines: the system is solved under several widths of their prior, and the
solutions are averaged by their evidence. Regular breathing hardly needs them, and they then add no noise.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, Projection, RoiDepth, frozen
from engine.core.locking_curve import corrected
from engine.core.motion_model import MotionModel
from engine.core.replacing import replace

STRIDE_PX = 4  # every fourth row and column is as accurate as every one: the noise is correlated over nine pixels
SAMPLED_SHAPE = (-(-ROI_ROWS // STRIDE_PX), -(-ROI_COLUMNS // STRIDE_PX))
COSINE_ROWS = 6
COSINE_COLUMNS = 4
PRIOR_SPREADS_MM = (0.1, 0.5, 3.0)
# The model's noise is that of 24 px squares. Over a whole mode it is 1.3 times as much per root of area, as its
# correlation reaches farther, and the sensor's fixed errors add to it. With less, cosines follow noise (ADR 0017).
NOISE_OF_MODES = 1.5
OUTLIER_MM = 6.0
INLIER_MM = 0.9 * OUTLIER_MM
MAX_REWEIGHTINGS = 12
CONVERGED_MM = 0.02
# After a first step this small from the previous frame no second is needed: it is exact without outliers.
SMALL_STEP_MM = 1.0
MAX_OUTLIERS_UNNOTICED = 0.01
MIN_SEEN_SHARE = 0.02
MIN_EXPLAINED_SHARE = 0.8
MIN_SLOPE = 0.1
# Least stiffness of a component, as a share of its sum over all points. A body that moves as a whole, such as a motion
# platform, has a first component that is a cosine too: sums of float32 do not tell the two apart, and the equations
# have no solution. With it they have one, and a coefficient is at most this share too small.
MIN_STIFFNESS = 1e-5
CHECK_CELL_PX = 25
CHECK_MIN_SHARE = 0.4
# Limits on the residual are for sensors whose noise, in the mean of a cell, is at most this. The largest of a hundred
# cells lies at six times its noise in a frame of a hundred: what a noisier sensor adds is taken off, up to a bound.
USUAL_CELL_NOISE_MM, MOST_CELL_NOISE_MM = 0.3, 0.9
LARGEST_OF_CELLS = 7.0
# Limits the effect of a single jump on a cell's mean misfit; a hand shifts all readings of a cell.
CHECK_CLIP_MM = np.float32(12.0)
_CELL_OF_ROW = np.arange(0, ROI_ROWS, STRIDE_PX, dtype=np.int64) // CHECK_CELL_PX
_CELL_OF_COLUMN = np.arange(0, ROI_COLUMNS, STRIDE_PX, dtype=np.int64) // CHECK_CELL_PX
_LIMITS = np.array(
    [
        *(OUTLIER_MM, INLIER_MM, CONVERGED_MM, SMALL_STEP_MM, MAX_OUTLIERS_UNNOTICED, MIN_SEEN_SHARE),
        *(MIN_EXPLAINED_SHARE, MIN_SLOPE, CHECK_CLIP_MM),
    ],
    dtype=np.float64,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Basis:
    """A model prepared for projection: components, then cosines, each with its prior.

    Attributes
    ----------
    sampled_components, sampled_mean_mm, sampled_known
        The components, the mean and what is known of it on every fourth row and column, flattened, shapes (k, s), (s,),
        (s,).
    cosine_rows, cosine_columns
        The cosines there, which are products of one along the rows and one along the columns: shapes (88, a), (50, b).
        Multiplied so they move a tenth of the memory that they would take as surfaces.
    points
        All modes, one row per sampled point, zero where the model is unknown, shape (s, k + e).
    stiffness
        What the prior adds to the normal equations at every width of the cosines' prior, shape (widths, k + e); the
        widest comes last.
    log_stiffness
        Half the sum of its logarithms, shape (widths,).
    variance_mm2
        Noise of a sampled pixel, blown up for its correlation with its neighbours [mm^2].
    reach
        Largest motion that a unit of each coefficient makes anywhere [mm], shape (k + e,).
    known_gram
        Products of the modes over all known pixels, shape (k + e, k + e), float64.
    noise_mm
        The noise of the training, as in `engine.core.motion_model.MotionModel` [mm].
    locking_table_mm
        What is taken off the readings, as `engine.core.locking_curve.corrected` takes it; None for nothing.
    """

    components: int
    sampled_components: FloatArray
    cosine_rows: FloatArray
    cosine_columns: FloatArray
    points: FloatArray
    sampled_mean_mm: FloatArray
    sampled_known: BoolArray
    stiffness: FloatArray
    log_stiffness: FloatArray
    variance_mm2: float
    reach: FloatArray
    known_gram: FloatArray
    noise_mm: float
    locking_table_mm: FloatArray | None = None

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.sampled_components, self.points, self.sampled_mean_mm, self.sampled_known):
            frozen(array)

    def surface_mm(self, coefficients: FloatArray) -> FloatArray:
        """Return what coefficients add to the mean at the sampled points [mm], shape (s,), float32."""
        small = coefficients.astype(np.float32)
        grid = small[self.components :].reshape(self.cosine_rows.shape[1], self.cosine_columns.shape[1])
        smooth = self.cosine_rows @ grid @ self.cosine_columns.T
        smooth += (small[: self.components] @ self.sampled_components).reshape(smooth.shape)
        return np.asarray(smooth.ravel())

    def products(self, field: FloatArray) -> FloatArray:
        """Sum a field at the sampled points, shape (s,), over each mode: shape (k + e,), float64."""
        grid = field.reshape(len(self.cosine_rows), len(self.cosine_columns))
        smooth = self.cosine_rows.T @ grid @ self.cosine_columns
        return np.concatenate([self.sampled_components @ field, smooth.ravel()]).astype(np.float64)


def modes_of(model: MotionModel) -> FloatArray:
    """Put the model's components and the smooth correction side by side: unit vectors, shape (k + e, 350, 200)."""
    return np.concatenate([model.components, _cosines()[0]])


def prepare_basis(model: MotionModel, modes: FloatArray | None = None) -> Basis:
    """Precompute what projections on a model need; ``modes`` are those of `modes_of`, where they are known already."""
    k = len(model.components)
    modes = modes_of(model) if modes is None else modes
    _, shares = _cosines()
    # A breath hold may be several times the training's excursion: the components' prior only keeps the system solvable.
    learned_mm = 10.0 * np.sqrt(np.maximum(model.eigenvalues_mm2[:k], 1.0))
    known = np.ascontiguousarray(model.known[::STRIDE_PX, ::STRIDE_PX]).ravel()
    sampled = np.ascontiguousarray(modes[:, ::STRIDE_PX, ::STRIDE_PX].reshape(len(modes), -1))
    sampled *= known
    variance_mm2 = (NOISE_OF_MODES * model.noise_mm / STRIDE_PX) ** 2
    widths_mm = np.array([np.concatenate([learned_mm, spread * shares]) for spread in PRIOR_SPREADS_MM])
    stiffness = variance_mm2 / widths_mm**2
    stiffness[:, :k] = np.maximum(stiffness[:, :k], MIN_STIFFNESS * (sampled[:k] ** 2).sum(axis=1))
    exact = sampled.astype(np.float64)
    return Basis(
        components=k,
        sampled_components=np.ascontiguousarray(sampled[:k]),
        cosine_rows=_cosine_rows()[::STRIDE_PX].astype(np.float32),
        cosine_columns=_cosine_columns()[::STRIDE_PX].astype(np.float32),
        points=np.ascontiguousarray(sampled.T),
        sampled_mean_mm=np.ascontiguousarray(model.mean_mm[::STRIDE_PX, ::STRIDE_PX]).ravel(),
        sampled_known=known,
        stiffness=stiffness,
        log_stiffness=0.5 * np.log(stiffness).sum(axis=1),
        variance_mm2=variance_mm2,
        reach=np.abs(sampled).max(axis=1).astype(np.float64),
        known_gram=exact @ exact.T,
        noise_mm=model.noise_mm,
        locking_table_mm=None if model.locking is None else model.locking.table_mm(),
    )


def noise_residual_mm(noise_mm: float) -> float:
    """Return what noise beyond the usual adds to the largest mean misfit of a cell [mm]; at most 4.2."""
    cell_mm = min(noise_mm / CHECK_CELL_PX, MOST_CELL_NOISE_MM)
    return LARGEST_OF_CELLS * max(cell_mm - USUAL_CELL_NOISE_MM, 0.0)


def project(basis: Basis, roi: RoiDepth, start: FloatArray | None, noise_mm: float | None = None) -> Projection | None:
    """Find the coefficients of one frame.

    Parameters
    ----------
    start
        Coefficients of the frame before, shape (k + e,), where there is one: a hand that just came in is then an
        outlier from its first frame.
    noise_mm
        The camera's noise now, where it is known [mm]: what it adds to the residual is taken off. That of the training
        otherwise.

    Returns
    -------
    Projection | None
        None when nothing of the region was seen, or nothing of it follows from what was seen.
    """
    thin = roi if roi.stride_px == STRIDE_PX else roi.thinned(STRIDE_PX)
    if basis.locking_table_mm is not None:
        thin = replace(thin, depth_mm=corrected(thin.depth_mm, basis.locking_table_mm))
    added_mm = noise_residual_mm(basis.noise_mm if noise_mm is None else noise_mm)
    return _projected(basis, thin, start, added_mm)


def _projected(basis: Basis, thin: RoiDepth, start: FloatArray | None, added_mm: float) -> Projection | None:
    """Find the coefficients; ``added_mm`` is taken off the residual."""
    compiled = FramePath.kernels
    if compiled is None:
        return _project_or_none(basis, thin, start, added_mm)
    coefficients, is_seen, figures = np.empty(len(basis.reach)), np.empty(SAMPLED_SHAPE, dtype=np.bool_), np.empty(4)
    is_projected: bool | None = compiled.project(
        basis.sampled_components,
        basis.cosine_rows,
        basis.cosine_columns,
        basis.points,
        basis.sampled_mean_mm,
        basis.sampled_known,
        basis.stiffness,
        basis.log_stiffness,
        basis.variance_mm2,
        basis.reach,
        basis.known_gram,
        np.ascontiguousarray(thin.depth_mm),
        np.ascontiguousarray(thin.valid),
        None if start is None else np.ascontiguousarray(start),
        _CELL_OF_ROW,
        _CELL_OF_COLUMN,
        _MIN_PIXELS,
        _LIMITS,
        MAX_REWEIGHTINGS,
        coefficients,
        is_seen,
        figures,
    )
    if is_projected is None:  # a matrix that is not positive, or a result that is not finite
        return _project_or_none(basis, thin, start, added_mm)
    if not is_projected:
        return None
    seen, inliers, known, residual_mm = figures.tolist()
    return Projection(
        beta=coefficients[: basis.components].copy(),
        coefficients=coefficients,
        residual_mm=max(residual_mm - added_mm, 0.0),
        valid_share=seen / max(known, 1.0),
        inlier_share=inliers / seen,
        is_seen=is_seen,
    )


def _project_or_none(basis: Basis, thin: RoiDepth, start: FloatArray | None, added_mm: float) -> Projection | None:
    try:
        found = _project(basis, thin, start)
        return None if found is None else replace(found, residual_mm=max(found.residual_mm - added_mm, 0.0))
    except np.linalg.LinAlgError:
        return None


def _project(basis: Basis, thin: RoiDepth, start: FloatArray | None) -> Projection | None:
    """Find the coefficients with numpy."""
    usable = thin.valid.ravel() & basis.sampled_known
    seen = int(np.count_nonzero(usable))
    if seen < MIN_SEEN_SHARE * usable.size:
        return None
    inside = usable.astype(np.float32)
    difference = (thin.depth_mm.ravel() - basis.sampled_mean_mm) * inside
    frame = _Frame(difference=difference, usable=usable, inside=inside, seen=seen)
    equations, widest = _settle(basis, frame, start)
    coefficients = _weigh_widths(basis, equations, widest)
    misfit = _misfit(basis, frame, coefficients)
    is_seen = usable & (np.abs(misfit) < INLIER_MM)
    return Projection(
        beta=coefficients[: basis.components].copy(),
        coefficients=coefficients,
        residual_mm=_largest_cell_misfit(misfit, inside),
        valid_share=seen / max(int(np.count_nonzero(basis.sampled_known)), 1),
        inlier_share=int(np.count_nonzero(is_seen)) / seen,
        is_seen=is_seen.reshape(SAMPLED_SHAPE),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Frame:
    """A frame at the sampled points: depth less the mean [mm], 0 in holes; the valid points, as bool and as 0 and 1."""

    difference: FloatArray
    usable: BoolArray
    inside: FloatArray
    seen: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Equations:
    """The data's part of the normal equations, ``gram @ coefficients = right``, without noise and prior."""

    gram: FloatArray
    right: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Answer:
    """The coefficients that solve the equations under one prior, and half the logarithm of the matrix's determinant."""

    coefficients: FloatArray
    log_determinant: float


def _settle(basis: Basis, frame: _Frame, start: FloatArray | None) -> tuple[_Equations, _Answer]:
    """Find the inliers, sum the normal equations over them, and solve these under the widest prior."""
    inliers, gram = frame.usable, _gram(basis, frame.usable)
    coefficients, misfit = _start(basis, frame, gram, start)
    limit_mm = SMALL_STEP_MM
    for _ in range(MAX_REWEIGHTINGS):
        ratio = _ratio(misfit)
        weights = (1.0 - ratio) ** 2 * frame.inside
        positive = weights > 0.0
        if int(np.count_nonzero(inliers != positive)) > MAX_OUTLIERS_UNNOTICED * inliers.size:
            inliers, gram, limit_mm = positive, _gram(basis, positive), CONVERGED_MM
        # Where nothing is an outlier the first step then goes all the way: Newton's, with the influence's mean slope.
        slope = float(frame.seen - 6.0 * ratio.sum() + 5.0 * (ratio @ ratio)) / max(int(np.count_nonzero(positive)), 1)
        pull = basis.products(weights * misfit) / max(slope, MIN_SLOPE)
        equations = _Equations(gram=gram, right=gram @ coefficients + pull)
        answer = _solve(equations, basis.stiffness[-1])
        step = answer.coefficients - coefficients
        if float(np.max(np.abs(step) * basis.reach)) < limit_mm:
            break
        coefficients, limit_mm = answer.coefficients, CONVERGED_MM
        misfit = _misfit(basis, frame, coefficients)
    return equations, answer


def _start(basis: Basis, frame: _Frame, gram: FloatArray, start: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Choose the start and its misfit: the previous frame, unless a fit to all pixels explains much more."""
    before = None if start is None else _misfit(basis, frame, start)
    if start is not None and before is not None and _explained(before, frame) >= MIN_EXPLAINED_SHARE:
        return start, before
    right = basis.products(frame.difference)
    unweighted = _solve(_Equations(gram=gram, right=right), basis.stiffness[-1]).coefficients
    misfit = _misfit(basis, frame, unweighted)
    if start is not None and before is not None and _explained(before, frame) >= _explained(misfit, frame):
        return start, before
    return unweighted, misfit


def _misfit(basis: Basis, frame: _Frame, coefficients: FloatArray) -> FloatArray:
    return (frame.difference - basis.surface_mm(coefficients)) * frame.inside


def _explained(misfit: FloatArray, frame: _Frame) -> float:
    """Share of the valid points that are explained, weighted by their misfit, 0 to 1."""
    return float(((1.0 - _ratio(misfit)) ** 2 * frame.inside).sum() / frame.seen)


def _gram(basis: Basis, usable: BoolArray) -> FloatArray:
    """Sum the modes' products over the usable points: from all known points less the few missing ones."""
    missing = np.flatnonzero(basis.sampled_known & ~usable)
    if 2 * len(missing) > usable.size:
        points = basis.points[np.flatnonzero(usable)]
        return np.asarray(points.T @ points, dtype=np.float64)
    points = basis.points[missing]
    return basis.known_gram - points.T @ points


def _weigh_widths(basis: Basis, equations: _Equations, widest: _Answer) -> FloatArray:
    """Average the answers under every width of the cosines' prior, each by its evidence."""
    answers = [*(_solve(equations, stiffness) for stiffness in basis.stiffness[:-1]), widest]
    evidence = basis.log_stiffness + [
        0.5 * float(equations.right @ answer.coefficients) / basis.variance_mm2 - answer.log_determinant
        for answer in answers
    ]
    likelihood = np.exp(evidence - evidence.max())
    return np.asarray((likelihood / likelihood.sum()) @ np.array([answer.coefficients for answer in answers]))


def _solve(equations: _Equations, stiffness: FloatArray) -> _Answer:
    """Solve the normal equations with a prior's stiffness added."""
    normal = equations.gram.copy()
    normal.ravel()[:: len(stiffness) + 1] += stiffness
    factor = np.linalg.cholesky(normal)
    answer = np.linalg.solve(normal, equations.right)
    return _Answer(coefficients=answer, log_determinant=float(np.log(factor.diagonal()).sum()))


def _ratio(misfit: FloatArray) -> FloatArray:
    """Square of a misfit over that of an outlier, up to 1; Tukey's weight is the square of what it lacks of 1."""
    ratio: FloatArray = np.minimum(misfit * misfit * np.float32(1.0 / OUTLIER_MM**2), np.float32(1.0))
    return ratio


def _cell_sums() -> tuple[FloatArray, FloatArray]:
    rows, columns = _CELL_OF_ROW, _CELL_OF_COLUMN
    return (
        (rows == np.arange(rows.max() + 1)[:, None]).astype(np.float32),
        (columns[:, None] == np.arange(columns.max() + 1)).astype(np.float32),
    )


_SUM_ROWS, _SUM_COLUMNS = _cell_sums()
_CELL_PIXELS = _SUM_ROWS.sum(axis=1)[:, None] * _SUM_COLUMNS.sum(axis=0)
_MIN_PIXELS = CHECK_MIN_SHARE * _CELL_PIXELS.astype(np.float64)


def _largest_cell_misfit(misfit: FloatArray, inside: FloatArray) -> float:
    clipped = np.minimum(np.maximum(misfit, -CHECK_CLIP_MM), CHECK_CLIP_MM)
    thin = np.stack([clipped, inside]).reshape(2, _SUM_ROWS.shape[1], _SUM_COLUMNS.shape[0])
    sums, counts = _SUM_ROWS @ thin @ _SUM_COLUMNS
    is_checked = counts >= _MIN_PIXELS
    if not is_checked.any():
        return float("nan")
    return float(np.abs(sums[is_checked] / counts[is_checked]).max())


def _cosine_rows() -> FloatArray:
    """Cosines along the rows, shape (350, a)."""
    return np.cos(np.pi * np.arange(COSINE_ROWS) * ((np.arange(ROI_ROWS) + 0.5) / ROI_ROWS)[:, None])


def _cosine_columns() -> FloatArray:
    """Cosines along the columns, shape (200, b)."""
    return np.cos(np.pi * np.arange(COSINE_COLUMNS) * ((np.arange(ROI_COLUMNS) + 0.5) / ROI_COLUMNS)[:, None])


def _cosines() -> tuple[npt.NDArray[np.float32], FloatArray]:
    """Low-order cosines (piston first) and their share of the prior's width, shapes (e, 350, 200) and (e,)."""
    shapes = np.einsum("ra,cb->abrc", _cosine_rows(), _cosine_columns()).reshape(-1, ROI_ROWS, ROI_COLUMNS)
    orders = np.arange(COSINE_ROWS)[:, None] ** 2 + np.arange(COSINE_COLUMNS) ** 2
    return shapes.astype(np.float32), 1.0 / (1.0 + orders.ravel())
