"""A proposed reference: where the patient's last breaths ended, for a person to confirm."""

import enum
from dataclasses import dataclass

from engine.core.breath import WHOLE, SignalChoice
from engine.core.position_check import PositionCheck
from engine.core.reference_distance import ReferenceDistance


class ReferenceMoment(enum.StrEnum):
    """The moment of the breath that a reference is set at; the value is the stable code."""

    END_EXHALE = "end_exhale"
    END_INHALE = "end_inhale"
    NOW = "now"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceProposal:
    """The mean position at the last ends of exhale, or of inhale, by the gated signal.

    Attributes
    ----------
    level, scatter
        Level against the present reference, and its standard deviation over the breaths [mm, l of the volume].
    breaths
        How many breaths it is the mean of.
    percent
        Its place in the learned breathing range: 0 at the end of exhale, 100 at the end of inhale. None where the range
        is not known.
    distance
        How far it lies from the fraction's first reference; None without one.
    position_check
        Where it lies against the plan's position; None without one, while the gate is armed, and for the end of inhale.
    """

    moment: ReferenceMoment
    signal: SignalChoice = WHOLE
    level: float
    scatter: float
    breaths: int
    percent: float | None
    distance: ReferenceDistance | None = None
    position_check: PositionCheck | None = None
