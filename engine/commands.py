"""What the service may ask of the engine; nothing here can turn a beam on.

Commands travel through a bounded queue and are answered through a future between two frames. Each names the person who
asked: the audit keeps it.
"""

from dataclasses import dataclass

from engine.model import MotionModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """Let the gate decide from now on; refused without a valid model, a reference and a fresh frame."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Disarm:
    """Hold the beam and leave the decision to nobody; never refused."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledge:
    """A named person has seen the latched fault; the gate returns to hold, disarmed."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SetReference:
    """Make the patient's present position the zero of motion; disarms."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Retrain:
    """Gather frames again and learn a new model in the background; it takes over when the gate is not armed.

    The zero is carried over, or the new model is refused; with ``keeps_zero`` false it is given up, and nobody may arm
    until a person has set it again.
    """

    operator: str
    keeps_zero: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class ApplyModel:
    """Let the model that waits take over now; disarms. Refused when none waits."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActivateModel:
    """Measure with this model as soon as the zero is carried over to it; disarms."""

    operator: str
    model: MotionModel


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldBeam:
    """Hold the beam until somebody releases it, or disarms; the gate stays armed. Never refused."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseBeam:
    """Take back what :class:`HoldBeam` asked for; the gate decides again, after a full dwell."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectBaseline:
    """Move the window by the baseline's drift, as a person has seen and confirmed it; disarms.

    Attributes
    ----------
    by
        How far the window moves [mm, l of the volume].
    """

    operator: str
    by: float


Command = (
    Arm
    | Disarm
    | Acknowledge
    | SetReference
    | Retrain
    | ApplyModel
    | ActivateModel
    | HoldBeam
    | ReleaseBeam
    | CorrectBaseline
)
