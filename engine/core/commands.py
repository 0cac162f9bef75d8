"""Commands of the service to the engine; none of them turns the beam on.

A bounded queue transfers commands, and futures return their results, between two frames. Each command names its
operator, for the audit.
"""

from dataclasses import dataclass

from engine.core.motion_model import MotionModel
from engine.core.reference import ReferenceMoment
from engine.core.signals import HeadDirection


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """Let the gate decide from now on; refused without a valid model, a reference and a fresh frame.

    Attributes
    ----------
    head_direction
        The side of the picture at which the operator sees the patient's head. It has to be the session's, and is
        required where the window is on a part of the patient.
    is_person
        Whether the operator is a person who is logged in; False for a program with a key.
    seen
        What the operator looked at, as the engine's status named it (`EngineStatus.arming_state`): refused if that is
        another by now. None is not compared.
    reason
        Required of a person where the window joins conditions by *or*; a program cannot arm such a window.
    """

    operator: str
    head_direction: HeadDirection | None = None
    is_person: bool = True
    seen: str | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Disarm:
    """Hold the beam and disarm the gate; never refused."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledge:
    """A named person has seen the latched fault; the gate returns to hold, disarmed."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SetReference:
    """Make a position of the patient the reference of motion; disarms.

    Attributes
    ----------
    moment
        The mean position of the last ends of exhale or inhale, or the present one.
    level_seen
        The level that the operator was shown [mm, l of the volume], if any: refused if it is another by now.
    move_seen_mm
        The movement of couch or camera since the last reference that the operator was shown. Required while one is
        seen, which the reference accepts; refused if it is another by now.
    reason
        Required where an amplitude window is used and the level is neither near the end of exhale nor of inhale, and
        beyond the budget from the fraction's first reference.
    may_exceed
        Whether the operator is a person who may arm: with a reason, the budget may be exceeded.
    """

    operator: str
    moment: ReferenceMoment = ReferenceMoment.NOW
    level_seen: float | None = None
    move_seen_mm: float | None = None
    reason: str = ""
    may_exceed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class SignPosition:
    """Sign the patient's position against the plan's, as it is with the reference in use.

    Attributes
    ----------
    reference_number
        The reference whose comparison the person was shown: refused if another one is in use by now.
    reason
        Required beyond the tolerance, and where a degree of freedom is not determined.
    may_exceed
        Whether the operator is a person who may arm: with a reason, a position beyond the tolerance may be signed.
    """

    operator: str
    reference_number: int
    reason: str = ""
    may_exceed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Countersign:
    """Countersign, as a second person, the reference and the window that would be armed.

    ``seen`` is what the person looked at, as in `Arm`: refused if it is another by now.
    """

    operator: str
    seen: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Retrain:
    """Collect frames and train a new model in the background; it becomes active while the gate is not armed.

    The reference is transferred, or the new model is refused; with ``keeps_zero`` false it is dropped, and arming is
    refused until it is set again. Tapes keep the name of that field.
    """

    operator: str
    keeps_zero: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class ApplyModel:
    """Activate the waiting model now; disarms. Refused if none waits."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActivateModel:
    """Measure with this model as soon as the reference is transferred to it; disarms."""

    operator: str
    model: MotionModel


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldBeam:
    """Hold the beam until it is released or the operator disarms; the gate stays armed. Never refused.

    A person's hold (``is_person``) is ended by a person, a program's by itself or a person.
    """

    operator: str
    is_person: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseBeam:
    """End the operator's own hold of :class:`HoldBeam`; the gate decides again, after a full dwell.

    A person without a hold ends those of all others, a program never. A person who releases answers for the armed gate
    from then on; a program (``is_person`` False) takes over from nobody.
    """

    operator: str
    is_person: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectBaseline:
    """Move the window by the baseline's drift, as an operator has confirmed it; disarms.

    Attributes
    ----------
    by
        Displacement of the window [mm, l of the volume].
    reason
        Required beyond the budget from the fraction's first reference.
    may_exceed
        Whether the operator is a person who may arm: with a reason, the budget may be exceeded.
    """

    operator: str
    by: float
    reason: str = ""
    may_exceed: bool = False
