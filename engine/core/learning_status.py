"""The state of learning as a value, its events for the audit, and how far the patient is from a stored model.

Published by the learner, read by everything else.
"""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from engine.core.errors import ModelMismatchError
from engine.core.motion_model import MotionModel
from engine.core.position_check import PositionCheck
from engine.core.reference import FirstReference, ReferenceDistance, ReferenceProposal

Figures = Mapping[str, float | int | str | None]
"""Values by name, unit included."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PatientMatch:
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LearningStatus:
    """The model and the reference in use.

    Attributes
    ----------
    model
        The model frames are measured with; None until one was learned or activated.
    model_shortcoming
        Why the gate may not be armed with this model, in a sentence; None where it may, or there is none.
    model_generation
        Changes whenever the model or the reference does: a gate that was armed before is disarmed.
    is_model_waiting
        Whether a new model is ready and waits for the gate to be disarmed.
    has_reference
        Whether motion is measured from a reference that the gate may be armed with.
    reference_number
        Counts the references that were set; one that is transferred to another model keeps its number.
    reference_proposals
        Positions of the last breaths that a person may make the reference; those that are known.
    reference_distance
        How far the reference in use lies from the fraction's first, without the window's correction; None without one.
    patient_match
        How far today's patient is from the stored model the session began with; None without one, or not known yet.
    position_check
        Where the reference in use lies against the plan's position; None without one, and in the plan's first fraction.
    is_position_required
        Whether another fraction of the plan has a position, so that a person has to sign this one.
    """

    model: MotionModel | None = None
    model_shortcoming: str | None = None
    model_generation: int = 0
    is_model_waiting: bool = False
    has_reference: bool = False
    reference_number: int = 0
    reference_proposals: tuple[ReferenceProposal, ...] = ()
    reference_distance: ReferenceDistance | None = None
    patient_match: PatientMatch | None = None
    position_check: PositionCheck | None = None
    is_position_required: bool = False


class LearningEventKind(enum.StrEnum):
    """What has happened."""

    STARTED = "retrain_started"
    READY = "ready"
    SWAPPED = "swapped"
    REFUSED = "refused"
    COMPARED = "compared"
    ZERO_NEEDED = "zero_needed"
    REFERENCE_SET = "reference_set"


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningEvent:
    """One event; ``figures`` are the values that decided it, ``first`` the first reference where it became known."""

    kind: LearningEventKind
    detail: str
    timestamp_us: int
    figures: Figures = field(default_factory=dict)
    first: FirstReference | None = None
