"""What a fraction binds the next arming to: the budget of its references, and the patient's signed position.

References, baseline corrections and windows share the budget, measured from the fraction's first ones. Beyond it a
person who may arm has to give a reason. What was moved in many small steps counts in full: no step is measured from
the one before. A window counts from the first one that was armed in the fraction, in whichever session, by how far it
reaches beyond that one. A person's reason makes the next window that is armed the first one.

A second person's signature belongs to the window that was armed with it: it lasts, over the sessions of the fraction,
while no window is set beyond that one and the reference is known to be within the budget (ADR 0055).

The position is signed before the first arming of a session of a later fraction (ADR 0031): a person signs how the
reference in use compares with the plan's position. The signature belongs to that reference, and ends when the patient
or the camera may have moved: then arming is refused, and an armed gate holds.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from engine.control.session_state import Learner, SessionLimits
from engine.core.breath import SignalChoice
from engine.core.clock import NS_PER_S
from engine.core.commands import Arm, CorrectBaseline, SetReference, SignPosition
from engine.core.errors import PositionUncheckedError, ReferenceDistanceError
from engine.core.fraction_arming import (
    MAX_ROUNDING,
    PHASE,
    FractionArming,
    PlacedCondition,
    PlacedWindow,
    is_set_beyond,
    reach_beyond,
)
from engine.core.frames import LostReason, Measurement, MeasurementState
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningStatus
from engine.core.position_check import PositionCheck, PositionTolerance
from engine.core.reference import ReferenceDistance, SignalLevel
from engine.core.sentences import listed, say
from engine.gating.active_window import SetWindow, window_text
from engine.gating.gate import Interruption
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, GateWindow, JoinedWindow, PhaseWindow, Unit

BUDGET_NO_REASON = "beyond it a person who may arm has to give a reason"

BUDGET_NOT_ALLOWED = "beyond it only a person who may arm can go, with a reason"

LONGEST_UNSEEN_S = 60.0
"""A patient who was not measured for longer may have been moved."""

CAMERA_MOVED = say("the camera moved")

UNSEEN = say("the patient was not measured for more than {longest_unseen_s:g} s", longest_unseen_s=LONGEST_UNSEEN_S)

NOT_SIGNED = say("the patient's position was not compared with the plan's and signed")

SET_AGAIN = say("set the reference again, compare the position with the plan's, and sign it")

NOT_ALLOWED = say("beyond the tolerance only a person who may arm can sign, with a reason")

NO_REASON = say("a person who may arm has to give a reason, such as by which other means it was checked")


def placed_window(
    window: GateWindow, reference: ReferenceDistance | None, as_set: GateWindow | None = None
) -> PlacedWindow | None:
    """Return where a window's edges lie against the fraction's first reference; None while any is in per cent.

    Parameters
    ----------
    reference
        That of the window, without its correction; None for the first one itself. A level that is not known counts as
        that of the first: a reference at an unknown distance has a person's reason of its own.
    as_set
        The window as it was prescribed; by default the same.
    """
    levels = {} if reference is None else {one.choice: one.level for one in reference.levels}
    join = window.join if isinstance(window, JoinedWindow) else ""
    leaves = zip(window.leaves, (as_set or window).leaves, strict=True)
    placed = [_placed(leaf, set_leaf, levels, join) for leaf, set_leaf in leaves]
    return None if None in placed else tuple(one for one in placed if one is not None)


def _placed(
    leaf: AmplitudeWindow | BreathHoldWindow | PhaseWindow,
    as_set: AmplitudeWindow | BreathHoldWindow | PhaseWindow,
    levels: Mapping[SignalChoice, float],
    join: str,
) -> PlacedCondition | None:
    hold = leaf.kind if isinstance(leaf, BreathHoldWindow) else ""
    kind = " ".join(filter(None, (join, type(leaf).__name__, hold, leaf.choices[0].label)))
    if isinstance(leaf, PhaseWindow):
        phases = (leaf.from_percent, leaf.to_percent)
        return PlacedCondition(kind, *phases, *phases, PHASE)
    edges = leaf.level if isinstance(leaf, BreathHoldWindow) else leaf
    set_edges = as_set.level if isinstance(as_set, BreathHoldWindow) else as_set
    if edges.unit is Unit.PERCENT or isinstance(set_edges, PhaseWindow):
        return None
    known, per_mm = levels.get(edges.choice, 0.0), edges.choice.per_mm
    level = known if math.isfinite(known) else 0.0
    lower, upper = ((edge + level) / per_mm for edge in (edges.lower, edges.upper))
    return PlacedCondition(kind, lower, upper, set_edges.lower, set_edges.upper, str(set_edges.unit))


class ReferenceBudget:
    """Compares what operators ask for with the budget; owned by the engine thread.

    Attributes
    ----------
    arming
        What the fraction was armed with, by this session or an earlier one; None where it was not.
    """

    def __init__(self, learner: Learner, limits: SessionLimits, arming: FractionArming | None = None) -> None:
        self._learner, self._limits = learner, limits
        self._has_reason = False
        self.arming = arming

    def present(self) -> ReferenceDistance | None:
        """Return how far reference and window lie from the fraction's first reference; None without a reference."""
        distance = self._learner.status.reference_distance
        return None if distance is None else distance.corrected(self._limits.correction)

    def checked_mm(self, command: SetReference) -> float | None:
        """Return the largest distance [mm] that the reference may have when it is taken up, None for any.

        Raises
        ------
        ReferenceDistanceError
            The position lies beyond the budget, or its distance is not known, without a person's reason.
        """
        distance = self._learner.reference_distance(command.moment)
        if self._may_exceed(command):
            self._has_reason = True
            return None
        if distance is not None:
            self._refuse_beyond("reference", distance, command)
        return self._limits.current.max_reference_distance_mm

    def check_correction(self, command: CorrectBaseline) -> None:
        """Refuse a correction that the window cannot have, or by which it lies beyond the budget.

        Raises
        ------
        InvalidValueError
            Beyond the site's limit of corrections.
        ReferenceDistanceError
            Beyond the budget, without a person's reason.
        """
        corrected = self._limits.corrected(command.by)
        if not self._may_exceed(command):
            self._refuse_beyond("by", self._now().corrected(command.by), command)
            self._refuse_reach("by", corrected.window, command)
        self._has_reason = self._may_exceed(command)

    def check_window(self, window: GateWindow, command: SetWindow) -> None:
        """Refuse a window that reaches further beyond the fraction's first than the budget; per cent at its arming.

        Raises
        ------
        ReferenceDistanceError
            Beyond the budget, without a person's reason.
        """
        if not self._may_exceed(command):
            self._refuse_reach("window", window, command)
        self._has_reason = self._may_exceed(command)

    def check_arming(self, command: Arm) -> None:
        """Refuse to arm a window beyond the budget, as references, corrections and per cent have made it.

        Raises
        ------
        ReferenceDistanceError
            Beyond the budget, without a person's reason, given now or with what led to it.
        """
        if not self._has_reason and not (command.is_person and command.reason.strip()):
            self._refuse_reach("window", self._limits.current.window, command)

    @property
    def is_reason_needed(self) -> bool:
        """Whether the present window is armed with a person's reason only."""
        reach_mm = self._reach_mm(self._limits.current.window)
        return not self._has_reason and not self._is_within(reach_mm)

    @property
    def is_unsigned(self) -> bool:
        """Whether no second person's signature covers the next arming.

        None was armed with in this fraction; or the window is set beyond the one that was, or lies beyond it by more
        than the budget with its reference and correction; or the distance of the reference is not known.
        """
        signed = None if self.arming is None else self.arming.signed
        placed = self._placed_now()
        if signed is None or placed is None:
            return True
        distance = self.present()
        is_known = distance is None or distance.distance_mm is not None
        return not is_known or is_set_beyond(signed, placed) or not self._is_within(reach_beyond(signed, placed))

    def note_armed(self, operator: str, signed_by: str | None) -> None:
        """Count from the window that was armed: the fraction's first, or one for which a person gave a reason.

        ``signed_by`` is the second person whose signature this arming needed; None where it needed none.
        """
        self._has_reason = False
        placed = self._placed_now()
        if placed is None:
            return
        if self.arming is None or not self._is_within(reach_beyond(self.arming.first, placed)):
            kept = FractionArming(first=placed, armed_by=operator)
            if self.arming is not None:
                kept = replace(self.arming, first=placed, armed_by=operator)
            self.arming = kept
        if signed_by is not None:
            self.arming = replace(self.arming, signed=placed, signed_by=signed_by, signed_for=operator)

    def _placed_now(self) -> PlacedWindow | None:
        """Return where the window in use lies; None while any of its edges is in per cent."""
        return placed_window(
            self._limits.current.window, self._learner.status.reference_distance, self._limits.prescribed_window
        )

    def _now(self) -> ReferenceDistance:
        """Return the present distance; that of the correction alone before a reference is set."""
        nowhere = SignalLevel(self._limits.prescribed_window.choices[0], 0.0)
        return self.present() or ReferenceDistance(moved_mm=0.0, levels=(nowhere,), correction=self._limits.correction)

    def _refuse_beyond(self, field: str, distance: ReferenceDistance, command: SetReference | CorrectBaseline) -> None:
        budget_mm = self._limits.current.max_reference_distance_mm
        if not distance.is_within(budget_mm):
            advice = BUDGET_NO_REASON if command.may_exceed else BUDGET_NOT_ALLOWED
            raise ReferenceDistanceError(field, distance.text, f"within {budget_mm:g} mm of it", advice)

    def _refuse_reach(self, field: str, window: GateWindow, command: SetWindow | CorrectBaseline | Arm) -> None:
        reach_mm, budget_mm = self._reach_mm(window), self._limits.current.max_reference_distance_mm
        if self._is_within(reach_mm):
            return
        may_exceed = command.is_person if isinstance(command, Arm) else command.may_exceed
        how_far = f"{reach_mm:.2f} mm" if math.isfinite(reach_mm) else "phases or conditions"
        value = f"{window_text(window)}, {how_far} beyond the fraction's first"
        advice = BUDGET_NO_REASON if may_exceed else BUDGET_NOT_ALLOWED
        raise ReferenceDistanceError(field, value, f"within {budget_mm:g} mm of it", advice)

    def _reach_mm(self, window: GateWindow) -> float:
        """Return how far a window reaches beyond the fraction's first [mm]; 0 for none, and while it is in per cent."""
        placed = placed_window(window, self._learner.status.reference_distance)
        return 0.0 if self.arming is None or placed is None else reach_beyond(self.arming.first, placed)

    def _is_within(self, reach_mm: float) -> bool:
        return reach_mm <= self._limits.current.max_reference_distance_mm + MAX_ROUNDING

    @staticmethod
    def _may_exceed(command: SetReference | CorrectBaseline | SetWindow) -> bool:
        return command.may_exceed and bool(command.reason.strip())


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


class PositionSignature:
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
