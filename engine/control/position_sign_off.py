"""The sign-off of the patient's position, before the first arming of a session of a later fraction (ADR 0031).

A person signs the comparison of the reference in use with the plan's position. The signature belongs to that reference,
and ends when the patient or the camera may have moved: then arming is refused, and an armed gate holds.

The patient's position against the plan's as a value: compared, signed, or lapsed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits
from engine.core.clock import NS_PER_S
from engine.core.commands import SignPosition
from engine.core.errors import PositionUncheckedError
from engine.core.frames import LostReason, Measurement, MeasurementState
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningStatus
from engine.core.position_check import PositionCheck, PositionTolerance
from engine.core.sentences import listed, say
from engine.gating.gate import Interruption

LONGEST_UNSEEN_S = 60.0
"""A patient who was not measured for longer may have been moved."""
CAMERA_MOVED = say("the camera moved")
UNSEEN = say("the patient was not measured for more than {longest_unseen_s:g} s", longest_unseen_s=LONGEST_UNSEEN_S)
NOT_SIGNED = say("the patient's position was not compared with the plan's and signed")
SET_AGAIN = say("set the reference again, compare the position with the plan's, and sign it")
NOT_ALLOWED = say("beyond the tolerance only a person who may arm can sign, with a reason")
NO_REASON = say("a person who may arm has to give a reason, such as by which other means it was checked")


class Signature(NamedTuple):
    """Who signed which reference's position, and why where it was beyond the tolerance."""

    operator: str
    reference_number: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionState:
    """The comparison of the reference in use with the plan's position, and its signature.

    Attributes
    ----------
    is_required
        Whether the gate may be armed with a signature only: another fraction of the plan has a position.
    reference_number
        Number of the reference in use; None while none is set.
    check
        Its comparison; None without one.
    signature
        The person who signed; None before the signature and after a lapse.
    lapse
        Why a signature of this reference is not valid any more; empty where it is.
    """

    is_required: bool = False
    reference_number: int | None = None
    check: PositionCheck | None = None
    tolerance: PositionTolerance
    signature: Signature | None = None
    lapse: str = ""

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """What keeps the position from being within the tolerance; empty where nothing does, or it is not compared."""
        return () if self.check is None else self.tolerance.shortcomings(self.check)


class PositionSignOff:
    """Keeps the signature; owned by the engine thread."""

    def __init__(self, learner: Learner, limits: SessionLimits) -> None:
        self._learner, self._limits = learner, limits
        self._signature: Signature | None = None
        self._lapsed_number: int | None = None
        self._lapse = ""
        self._seen_ns: int | None = None

    @property
    def tolerance(self) -> PositionTolerance:
        """The site's tolerance."""
        limits = self._limits.current
        return PositionTolerance(
            shift_mm=limits.max_position_shift_mm,
            turn_deg=limits.max_position_turn_deg,
            shape_mm=limits.max_position_shape_mm,
        )

    def present(self) -> PositionState:
        """Return the comparison of the reference in use, and its signature."""
        learning = self._learner.status
        return PositionState(
            is_required=learning.is_position_required,
            reference_number=learning.reference_number if learning.has_reference else None,
            check=learning.position_check,
            tolerance=self.tolerance,
            signature=self._valid(learning),
            lapse=self._lapse if self._lapsed_number == learning.reference_number else "",
        )

    def sign(self, command: SignPosition) -> None:
        """Sign the position of the reference in use.

        Raises
        ------
        PositionUncheckedError
            There is nothing to sign; another reference is in use by now; the patient may have moved since; or the
            position is beyond the tolerance, without a reason of a person who may arm.
        """
        learning = self._learner.status
        if not learning.is_position_required:
            raise PositionUncheckedError(say("nothing is to be signed: no earlier fraction of the plan has a position"))
        if not learning.has_reference:
            raise PositionUncheckedError(say("there is no reference yet: set it, and look at its position"))
        if command.reference_number != learning.reference_number:
            raise PositionUncheckedError(
                say(
                    "reference {reference_number} is in use by now, not {seen_number}: look again",
                    reference_number=learning.reference_number,
                    seen_number=command.reference_number,
                )
            )
        if self._lapsed_number == learning.reference_number:
            raise PositionUncheckedError(say("{lapse}: {set_again}", lapse=self._lapse, set_again=SET_AGAIN))
        self._refuse_beyond(command)
        self._signature = Signature(
            operator=command.operator, reference_number=command.reference_number, reason=command.reason.strip()
        )

    def follow(self, measurement: Measurement, holds: Iterable[Interruption]) -> None:
        """End the signature where a frame, or a hold of its supervision, shows that the patient or camera has moved."""
        moved = next((one for one in holds if one.reason is HoldReason.PATIENT_SHIFTED), None)
        if moved is not None:
            self._end(say("the patient {detail}", detail=moved.detail))
        if measurement.lost is not None and measurement.lost.reason is LostReason.CAMERA_MOVED:
            self._end(CAMERA_MOVED)
        if measurement.state is MeasurementState.MEASURING or self._seen_ns is None:
            self._seen_ns = measurement.received_ns
        elif measurement.received_ns - self._seen_ns > LONGEST_UNSEEN_S * NS_PER_S:
            self._end(UNSEEN)

    def interruption(self) -> Interruption | None:
        """Return the hold of a position that has to be signed and is not."""
        learning = self._learner.status
        if not learning.is_position_required or not learning.has_reference or self._valid(learning) is not None:
            return None
        return Interruption(HoldReason.POSITION_UNCHECKED, self._text(learning))

    def refuse_unsigned(self) -> None:
        """Raise PositionUncheckedError where the position has to be signed and is not."""
        found = self.interruption()
        if found is not None:
            raise PositionUncheckedError(
                say("{found}: {advice}", found=found.detail, advice=SET_AGAIN if self._lapse else say("sign it first"))
            )

    def _end(self, why: str) -> None:
        """End the signature of the reference in use, and refuse another one."""
        learning = self._learner.status
        if learning.is_position_required and self._lapsed_number != learning.reference_number:
            self._lapsed_number, self._lapse = learning.reference_number, why

    def _valid(self, learning: LearningStatus) -> Signature | None:
        """Return the signature of the reference in use, if it is still valid."""
        signature, number = self._signature, learning.reference_number
        is_valid = signature is not None and signature.reference_number == number and self._lapsed_number != number
        return signature if is_valid and learning.has_reference else None

    def _text(self, learning: LearningStatus) -> str:
        if self._lapsed_number == learning.reference_number:
            return say("the signature of the position ended: {lapse}", lapse=self._lapse)
        return NOT_SIGNED

    def _refuse_beyond(self, command: SignPosition) -> None:
        check = self._learner.status.position_check
        shortcomings = (say("it was not compared"),) if check is None else self.tolerance.shortcomings(check)
        if not shortcomings or (command.may_exceed and command.reason.strip()):
            return
        limits = say(
            "{shift_mm:g} mm and {turn_deg:g} deg", shift_mm=self.tolerance.shift_mm, turn_deg=self.tolerance.turn_deg
        )
        advice = NO_REASON if command.may_exceed else NOT_ALLOWED
        raise PositionUncheckedError(
            say(
                "the position is not within {limits} of the plan's ({shortcomings}): {advice}",
                limits=limits,
                shortcomings=listed(", ", shortcomings),
                advice=advice,
            )
        )
