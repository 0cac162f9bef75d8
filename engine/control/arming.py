"""What an arming needs, as one list, and what it would take: shown to the person, and compared when the gate is armed.

The second person's countersignature is of exactly what an arming would take. The site may want it before the first
arming of a fraction; it ends with any change of window, reference, model or head direction. A window beyond the
fraction's budget, for which a person gave a reason, needs another one.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

from engine.control.fraction_checks import PositionSignature, ReferenceBudget
from engine.control.session_state import Learner, SessionLimits
from engine.core.commands import Arm, Countersign
from engine.core.errors import CommandRefusedError, CountersignatureError, HeadDirectionError
from engine.core.fraction_arming import FractionArming
from engine.core.gate_state import GateState
from engine.core.sentences import say
from engine.core.signals import Ranges, ranges_of
from engine.gating.active_window import duty_percent, refuse_hold_in_free_breath, refuse_never_left, unresolved_text
from engine.gating.frame_checks import HEAD_DIRECTION_UNKNOWN
from engine.gating.gate import Gate
from engine.gating.windows import GateWindow, Join, JoinedWindow

OTHER_STATE = say("window, reference, model or head direction is another than the one that was looked at: look again")
NOT_WHAT_WAS_SEEN = say("{advice}, then arm", advice=OTHER_STATE)


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


class Arming:
    """What an arming needs and would take; owned by the engine thread. ``reference_by`` is who set the reference."""

    def __init__(self, learner: Learner, limits: SessionLimits, fraction: FractionArming | None = None) -> None:
        self._learner, self._limits = learner, limits
        self.budget = ReferenceBudget(learner, limits, fraction)
        self.position = PositionSignature(learner, limits)
        self.countersignature = Countersignature(self.budget, limits)
        self.forecast = DutyForecast(learner, limits)
        self.reference_by = ""
        self._hashed: tuple[object, ...] = ()
        self._hash = ""

    def refuse(
        self,
        command: Arm,
        gate: Gate,
        *,
        operator_absence: str,
        is_watchdog_running: bool,
        refuse_old_frame: Callable[[], None],
    ) -> None:
        """Refuse an arming that lacks anything; this is the list, in the order in which a person reads the refusals.

        ``operator_absence`` says that no person who may arm is present, for a program that arms; ``refuse_old_frame``
        raises unless every signal of the window was measured a moment ago.

        Raises
        ------
        TidegateError
            The first thing that is missing: a CommandRefusedError, or an error of what refuses.
        """
        if operator_absence:
            raise CommandRefusedError(
                say(
                    "{operator_absence}: a person has to log in there, and keep it visible",
                    operator_absence=operator_absence,
                )
            )
        self._refuse_unless_ready(gate, is_watchdog_running=is_watchdog_running, refuse_old_frame=refuse_old_frame)
        if command.seen is not None and command.seen != self.state:
            raise CommandRefusedError(NOT_WHAT_WAS_SEEN)
        self._refuse_other_head(command)
        self._refuse_unreasoned_way(command)
        self.forecast.refuse_free_breath()
        self.budget.check_arming(command)
        self.countersignature.refuse_unsigned(command, self.state, reference_by=self.reference_by)

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
        return self.has_ways or self.budget.is_reason_needed

    @property
    def signed(self) -> CountersignatureState:
        """Whether the next arming needs a second person's countersignature, and who has given it."""
        return self.countersignature.present(self.state)

    def _refuse_unless_ready(
        self, gate: Gate, *, is_watchdog_running: bool, refuse_old_frame: Callable[[], None]
    ) -> None:
        """Refuse while a fault is latched, nothing is learned, or nothing is measured, recorded or supervised."""
        if gate.state is GateState.FAULT:
            raise CommandRefusedError(say("a fault is latched ({reason}): acknowledge it first", reason=gate.reason))
        if gate.is_armed:
            raise CommandRefusedError(say("the gate is armed already"))
        if self._learner.status.model is None:
            raise CommandRefusedError(say("there is no motion model yet: wait for the training to end"))
        if self._learner.status.model_shortcoming is not None:
            raise CommandRefusedError(self._learner.status.model_shortcoming)
        if not self._learner.status.has_reference:
            raise CommandRefusedError(say("there is no reference yet: set it first"))
        if self._limits.is_window_unresolved:
            raise CommandRefusedError(unresolved_text(self._limits.current.window))
        self.position.refuse_unsigned()
        self._limits.refuse_wide_window()
        if not is_watchdog_running:
            raise CommandRefusedError(say("the watchdog does not run: this engine cannot be armed"))
        refuse_old_frame()

    def _refuse_other_head(self, command: Arm) -> None:
        """Refuse a head direction that is not the session's, and none where the window is on a part of the patient."""
        limits, confirmed = self._limits.current, command.head_direction
        lies = (
            say("unknown")
            if limits.head_direction is None
            else say("at the {head_direction} of the picture", head_direction=limits.head_direction)
        )
        if confirmed is not None and confirmed is not limits.head_direction:
            raise HeadDirectionError(
                say(
                    "the head is confirmed at the {confirmed}, and in this session it is {lies}",
                    confirmed=confirmed,
                    lies=lies,
                )
            )
        if not limits.needs_head_direction or confirmed is not None:
            return
        if limits.head_direction is None:
            raise HeadDirectionError(
                say(
                    "{head_direction_unknown}: create the session with head_direction",
                    head_direction_unknown=HEAD_DIRECTION_UNKNOWN,
                )
            )
        raise HeadDirectionError(
            say("the head is {lies}: see that it is, and confirm head_direction with the arming", lies=lies)
        )

    def _refuse_unreasoned_way(self, command: Arm) -> None:
        """Refuse a window with several ways into the beam to a program, and without a person's reason."""
        if not self.has_ways:
            return
        if not command.is_person or not command.reason.strip():
            raise CommandRefusedError(
                say(
                    "the window joins conditions by or, each of which permits the beam: a person arms it, with a reason"
                )
            )


def _has_ways(window: GateWindow) -> bool:
    return isinstance(window, JoinedWindow) and window.join is Join.OR
