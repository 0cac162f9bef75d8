"""What a recording's first pass has learned, for the second."""

from dataclasses import dataclass

from engine.core.patient_match import PatientMatch
from engine.motion.learning.prepared_model import PreparedModel, Reference


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Learned:
    """A model, and the reference that motion was measured from; ``reference`` is None if nothing was measured."""

    active: PreparedModel | None
    reference: Reference | None
    reference_number: int
    needs_reference: bool
    patient_match: PatientMatch | None
