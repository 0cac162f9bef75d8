"""Match of a stored model with the patient: residual, rigid shift and tilt, and remaining difference of shape.

The model stores the mean surface of its training at the nodes, in the depth camera's frame; the patient is measured at
the same nodes. Shift and tilt describe the patient's position; the remaining difference of shape shows whether it is
the same patient with the markers at the same places.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from engine.core.bounds import check_numbers
from engine.core.errors import ModelMismatchError
from engine.core.learning_status import PatientMatch
from engine.motion.learning.position_fit import rigid_between
from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.learning.reference_transfer import Explain
from engine.motion.learning.training_set import TrainingFrame, Vertices, mean_surface

PATIENT_MATCH_BOUNDS: Mapping[str, tuple[float, float]] = {
    "seconds": (0.5, 20.0),
    "max_shift_mm": (1.0, 200.0),
    "max_tilt_deg": (0.5, 45.0),
    "max_shape_mm": (0.5, 30.0),
    "max_residual_mm": (0.1, 20.0),
    "min_explained_share": (0.1, 1.0),
}
"""Lowest and highest value of each limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PatientMatchLimits:
    """Limits of the match between a stored model and the patient.

    Attributes
    ----------
    seconds
        Time over which frames are compared [s]; about a breath, so that its phase averages out.
    max_shift_mm, max_tilt_deg
        Largest shift and tilt relative to the training.
    max_shape_mm
        Largest root mean square difference of the surfaces after the rigid motion.
    max_residual_mm
        Largest median of the frames' residuals.
    min_explained_share
        Least share of the frames that the model explains, 0 to 1.
    """

    seconds: float = 4.0
    max_shift_mm: float = 20.0
    max_tilt_deg: float = 5.0
    max_shape_mm: float = 3.0
    max_residual_mm: float = 3.0
    min_explained_share: float = 0.8

    def __post_init__(self) -> None:
        """Check every number against its bounds; raise InvalidValueError."""
        check_numbers(self, PATIENT_MATCH_BOUNDS)


def compare_with_patient(
    active: PreparedModel,
    frames: Sequence[TrainingFrame],
    limits: PatientMatchLimits,
    *,
    explain: Explain,
    vertices: Vertices,
) -> PatientMatch:
    """Compare a stored model with frames of the patient.

    Raises
    ------
    ModelMismatchError
        The model has no stored surface, or too little of the patient is visible.
    """
    learned = active.model.surface_mm
    seen = mean_surface(frames, vertices)
    if learned is None or learned.shape != seen.shape:
        bound = "one that stores its patient's surface"
        raise ModelMismatchError("model", "of an older version", bound, "learn a new one")
    rigid = rigid_between(learned, seen)
    if rigid is None:
        raise ModelMismatchError("model.seen", "too little of the region", "visible", "clear the view of the camera")
    residuals_mm = _residuals_mm(active, frames, explain)
    figures = PatientMatch(
        frames=len(frames),
        explained_share=len(residuals_mm) / len(frames),
        residual_mm=float(np.median(residuals_mm)) if residuals_mm else None,
        shift_mm=rigid.shift_mm,
        tilt_deg=rigid.tilt_deg,
        shape_mm=rigid.shape_mm,
    )
    return with_refusal(figures, limits)


def with_refusal(figures: PatientMatch, limits: PatientMatchLimits) -> PatientMatch:
    """Return the figures with the refusal, if one of them exceeds its limit."""
    advice = "the model is of another patient, or the markers are at other places: learn a new model"
    moved = "the patient's position differs from the training: correct the set-up, or learn a new model"
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


def _residuals_mm(active: PreparedModel, frames: Sequence[TrainingFrame], explain: Explain) -> list[float]:
    found: list[float] = []
    coefficients = None
    for frame in frames:
        outcome = explain(active, frame.roi, coefficients)
        coefficients = None if outcome is None else outcome.coefficients
        if outcome is not None:
            found.append(outcome.residual_mm)
    return found
