"""How far today's patient is from a stored model: residual, rigid shift and tilt, and what is left of the shape.

The model carries the mean surface of its training in the depth camera's frame, node by node between the markers; the
patient of today is seen at the same nodes. Shift and tilt say how the patient lies, the shape that is left says whether
it is the same patient with the markers at the same places.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from engine.active_model import ActiveModel
from engine.carry import Explain
from engine.errors import ModelMismatchError
from engine.gathering import GatheredFrame, Vertices, mean_surface
from engine.rigid import rigid_between
from engine.training import check_bound


@dataclass(frozen=True, slots=True, kw_only=True)
class LikenessLimits:
    """How far today's patient may be from a stored model.

    Attributes
    ----------
    seconds
        How long the patient is looked at; about a breath, so that its phase averages out.
    max_shift_mm, max_tilt_deg
        How the patient may lie against the training.
    max_shape_mm
        Root mean square difference of the surfaces when shift and tilt are taken out.
    max_residual_mm
        Median over the frames of the largest mean misfit of a cell.
    min_explained_share
        Share of the frames that the model must explain at all.
    """

    seconds: float = 4.0
    max_shift_mm: float = 20.0
    max_tilt_deg: float = 5.0
    max_shape_mm: float = 3.0
    max_residual_mm: float = 3.0
    min_explained_share: float = 0.8

    def __post_init__(self) -> None:
        """Refuse every number out of its bound."""
        for name, (low, high) in LIKENESS_BOUNDS.items():
            check_bound(name, getattr(self, name), low, high)


LIKENESS_BOUNDS: Mapping[str, tuple[float, float]] = {
    "seconds": (0.5, 20.0),
    "max_shift_mm": (1.0, 200.0),
    "max_tilt_deg": (0.5, 45.0),
    "max_shape_mm": (0.5, 30.0),
    "max_residual_mm": (0.1, 20.0),
    "min_explained_share": (0.1, 1.0),
}
"""Lowest and highest value of each limit; a site can only choose within."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Likeness:
    """How far the patient of today is from a stored model.

    Attributes
    ----------
    residual_mm
        Median over the explained frames of the largest mean misfit of a cell [mm]; None where none was explained.
    explained_share
        Share of the frames that the model explains, 0 to 1.
    shift_mm
        From the training to today, in the depth camera's frame (x, y, z) [mm]; z is away from the camera.
    tilt_deg
        Rotation about the region's centre [deg].
    shape_mm
        Root mean square difference of the surfaces that shift and tilt do not explain [mm].
    refusal
        Why the model is not to be used on this patient; None when it may.
    """

    frames: int
    explained_share: float
    residual_mm: float | None
    shift_mm: tuple[float, float, float]
    tilt_deg: float
    shape_mm: float
    refusal: ModelMismatchError | None = None

    @property
    def distance_mm(self) -> float:
        """Length of the shift [mm]."""
        return float(np.linalg.norm(self.shift_mm))


def compare_with_patient(
    active: ActiveModel,
    frames: Sequence[GatheredFrame],
    limits: LikenessLimits,
    *,
    explain: Explain,
    vertices: Vertices,
) -> Likeness:
    """Look at the patient of today with a stored model.

    Raises
    ------
    ModelMismatchError
        The model has no surface to compare with, or too little of the patient is seen.
    """
    learned = active.model.surface_mm
    seen = mean_surface(frames, vertices)
    if learned is None or learned.shape != seen.shape:
        bound = "one that says where its patient lay"
        raise ModelMismatchError("model", "of an older version", bound, "learn a new one")
    rigid = rigid_between(learned, seen)
    if rigid is None:
        raise ModelMismatchError("model.seen", "too little of the region", "seen", "clear the view of the camera")
    residuals_mm = _residuals_mm(active, frames, explain)
    figures = Likeness(
        frames=len(frames),
        explained_share=len(residuals_mm) / len(frames),
        residual_mm=float(np.median(residuals_mm)) if residuals_mm else None,
        shift_mm=rigid.shift_mm,
        tilt_deg=rigid.tilt_deg,
        shape_mm=rigid.shape_mm,
    )
    return judged(figures, limits)


def judged(figures: Likeness, limits: LikenessLimits) -> Likeness:
    """Add the refusal, where one of the figures is beyond its limit."""
    advice = "this is not the patient the model knows, or the markers lie elsewhere: learn a new model"
    moved = "the patient lies elsewhere than in the training: see to the set-up, or learn a new model"
    checks = (
        ("model.shift_mm", figures.distance_mm, limits.max_shift_mm, moved),
        ("model.tilt_deg", figures.tilt_deg, limits.max_tilt_deg, moved),
        ("model.shape_mm", figures.shape_mm, limits.max_shape_mm, advice),
        ("model.residual_mm", figures.residual_mm, limits.max_residual_mm, advice),
    )
    refusal = None
    if not figures.explained_share >= limits.min_explained_share:
        bound = f"at least {limits.min_explained_share:g}"
        refusal = ModelMismatchError("model.explained_share", f"{figures.explained_share:.2f}", bound, advice)
    for field, value, most, what in checks:
        if refusal is None and not (value is not None and value <= most):
            shown = "not known" if value is None else f"{value:.1f}"
            refusal = ModelMismatchError(field, shown, f"at most {most:g}", what)
    return replace(figures, refusal=refusal)


def _residuals_mm(active: ActiveModel, frames: Sequence[GatheredFrame], explain: Explain) -> list[float]:
    found: list[float] = []
    coefficients = None
    for frame in frames:
        outcome = explain(active, frame.roi, coefficients)
        coefficients = None if outcome is None else outcome.coefficients
        if outcome is not None:
            found.append(outcome.residual_mm)
    return found
