"""What the learning of motion models has come to, as a value: published by the learner, read by everything else."""

from dataclasses import dataclass

from engine.core.motion_model import MotionModel
from engine.core.patient_match import PatientMatch
from engine.core.position_check import PositionCheck
from engine.core.reference_distance import ReferenceDistance
from engine.core.reference_proposal import ReferenceProposal


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
    is_fraction_continued
        Whether another session has set the fraction's first reference.
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
    is_fraction_continued: bool = False
