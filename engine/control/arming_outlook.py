"""What an arming would take now, and whose word it needs: shown to the person, and compared when the gate is armed.

The learned breaths against the window in use, computed again when the model, the reference or the window changes.

The second person's countersignature of the reference and the window, before the first arming of a fraction.

Asked for where the site wants it. It is of exactly what an arming would take (`CommandHandler.arming_state`), and ends
with any change of window, reference, model or head direction. A window beyond the fraction's budget, for which a person
gave a reason, needs another one.
"""

import hashlib
from dataclasses import dataclass

from engine.control.reference_budget import ReferenceBudget
from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits
from engine.core.commands import Arm, Countersign
from engine.core.errors import CountersignatureError
from engine.core.sentences import say
from engine.core.signals import Ranges, ranges_of
from engine.gating.active_window import duty_percent, refuse_hold_in_free_breath, refuse_never_left
from engine.gating.windows import GateWindow, Join, JoinedWindow

OTHER_STATE = say("window, reference, model or head direction is another than the one that was looked at: look again")


@dataclass(frozen=True, slots=True, kw_only=True)
class CountersignatureState:
    """Whether the next arming needs a countersignature, and who has signed what it would take, if anyone."""

    is_required: bool = False
    signed_by: str | None = None


class Countersignature:
    """Keeps the signature; owned by the engine thread."""

    def __init__(self, budget: ReferenceBudget, limits: SessionLimits) -> None:
        self._budget, self._limits = budget, limits
        self._operator: str | None = None
        self._state = ""

    def present(self, arming_state: str) -> CountersignatureState:
        """Return what the next arming needs and has; ``arming_state`` is the hash of what it would take."""
        is_signed = self._state == arming_state
        return CountersignatureState(
            is_required=self.is_required, signed_by=self._operator if self.is_required and is_signed else None
        )

    @property
    def is_required(self) -> bool:
        """Whether the next arming is one that a second person has to countersign."""
        return self._limits.current.needs_countersignature and self._budget.is_unsigned

    def sign(self, command: Countersign, arming_state: str) -> None:
        """Sign what was looked at.

        Raises
        ------
        CountersignatureError
            Nothing is to be countersigned, or it is another state by now.
        """
        if not self.is_required:
            raise CountersignatureError(say("nothing is to be countersigned: the next arming needs no second person"))
        if command.seen != arming_state:
            raise CountersignatureError(OTHER_STATE)
        self._operator, self._state = command.operator, arming_state

    def refuse_unsigned(self, command: Arm, arming_state: str, *, reference_by: str) -> None:
        """Raise CountersignatureError where the arming needs a signature of another person and has none.

        Another than the person who arms; where a program arms, than ``reference_by``, who set the reference.
        """
        found = self.present(arming_state)
        if not found.is_required:
            return
        if found.signed_by is None:
            raise CountersignatureError(say("a second person has to countersign the reference and the window first"))
        if found.signed_by == (command.operator if command.is_person else reference_by):
            what = say("arm") if command.is_person else say("set the reference")
            raise CountersignatureError(
                say("{signed_by} has countersigned: another person has to {what}", signed_by=found.signed_by, what=what)
            )


class DutyForecast:
    """How much of the learned breaths lies in the window, and their range; owned by the engine thread."""

    def __init__(self, learner: Learner, limits: SessionLimits) -> None:
        self._learner, self._limits = learner, limits
        self._made_for: tuple[object, ...] | None = None
        self._percent: float | None = None
        self._ranges: Ranges = {}

    @property
    def percent(self) -> float | None:
        """The predicted duty cycle, 0 to 100; None where it is not known, and for breath holds."""
        self._make()
        return self._percent

    @property
    def ranges(self) -> Ranges:
        """The learned range of each signal of the window; signals whose range is not known are absent."""
        self._make()
        return self._ranges

    def _make(self) -> None:
        status, window = self._learner.status, self._limits.current.window
        present = (status.model_generation, status.reference_number, status.has_reference, window)
        if present != self._made_for:
            self._made_for = present
            levels = self._learner.learned_levels(window.choices)
            self._percent, self._ranges = duty_percent(window, levels), ranges_of(levels)

    def refuse_free_breath(self) -> None:
        """Refuse a window that the learned breaths never leave, or a breath hold that they reach.

        Raises
        ------
        InvalidValueError
            More of the learned breaths lie inside than the site allows, or a hold lies where the patient breathes.
        CommandRefusedError
            The learned breaths are not known.
        """
        limits = self._limits.current
        levels = self._learner.learned_levels(limits.window.choices)
        refuse_never_left(limits, levels)
        refuse_hold_in_free_breath(limits, levels)


class ArmingOutlook:
    """Owned by the engine thread.

    Attributes
    ----------
    countersignature
        The second person's, for the present `state`.
    forecast
        Share of the learned breaths inside the window.
    """

    def __init__(self, learner: Learner, limits: SessionLimits, budget: ReferenceBudget) -> None:
        self._learner, self._limits, self._budget = learner, limits, budget
        self.countersignature = Countersignature(budget, limits)
        self.forecast = DutyForecast(learner, limits)
        self._hashed: tuple[object, ...] = ()
        self._hash = ""

    @property
    def state(self) -> str:
        """Hash of what an arming would take; the same only for the same window, reference, model and head direction."""
        learning, limits = self._learner.status, self._limits.current
        present = (
            limits.window,
            (limits.dwell_ms, limits.min_on_ms, limits.min_off_ms, limits.max_cycles_per_min),
            limits.head_direction,
            learning.model_generation,  # of the reference too
        )
        if present != self._hashed:
            self._hashed, self._hash = present, hashlib.sha256(repr(present).encode()).hexdigest()[:32]
        return self._hash

    @property
    def has_ways(self) -> bool:
        """Whether any one of several conditions permits the beam."""
        return _has_ways(self._limits.current.window)

    @property
    def is_reason_needed(self) -> bool:
        """Whether the window is armed by a person with a reason only: joined by or, or beyond the fraction's budget."""
        return self.has_ways or self._budget.is_reason_needed

    @property
    def signed(self) -> CountersignatureState:
        """Whether the next arming needs a second person's countersignature, and who has given it."""
        return self.countersignature.present(self.state)


def _has_ways(window: GateWindow) -> bool:
    return isinstance(window, JoinedWindow) and window.join is Join.OR
