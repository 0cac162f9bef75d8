"""The second person's countersignature of the reference and the window, before the first arming of a fraction.

Asked for where the site wants it. It is of exactly what an arming would take (`CommandHandler.arming_state`), and ends
with any change of window, reference, model or head direction. A window beyond the fraction's budget, for which a person
gave a reason, needs another one.
"""

from dataclasses import dataclass

from engine.control.reference_budget import ReferenceBudget
from engine.control.session_limits import SessionLimits
from engine.core.commands import Arm, Countersign
from engine.core.errors import CountersignatureError

OTHER_STATE = "window, reference, model or head direction is another than the one that was looked at: look again"


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
        return self._limits.current.needs_countersignature and self._budget.is_first_arming

    def sign(self, command: Countersign, arming_state: str) -> None:
        """Sign what was looked at.

        Raises
        ------
        CountersignatureError
            Nothing is to be countersigned, or it is another state by now.
        """
        if not self.is_required:
            raise CountersignatureError("nothing is to be countersigned: the next arming needs no second person")
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
            raise CountersignatureError("a second person has to countersign the reference and the window first")
        if found.signed_by == (command.operator if command.is_person else reference_by):
            what = "arm" if command.is_person else "set the reference"
            raise CountersignatureError(f"{found.signed_by} has countersigned: another person has to {what}")
