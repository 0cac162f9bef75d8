"""In whose name a request acts: the authenticated one, whatever its body claims."""

from dataclasses import dataclass

from service.access import behalf
from service.access.identity import Identity
from service.errors import OperatorMismatchError

NOT_GIVEN = ""
"""What `operator` is in a request that leaves it out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calling:
    """Who calls."""

    identity: Identity

    @property
    def name(self) -> str:
        """The audit's actor."""
        return self.identity.name

    def acts_as(self, operator: str) -> str:
        """Return in whose name this is done, once the body's ``operator`` is known to be no one else.

        Raises
        ------
        OperatorMismatchError
            A person asks in another one's name: the page was left open, or somebody else has logged in since.
        """
        if self.identity.is_person and operator not in {NOT_GIVEN, self.name}:
            msg = f"{self.name} is logged in, and asks as somebody else"
            bound = f"left out, or {self.name}"
            raise OperatorMismatchError(msg, field="operator", value=operator, bound=bound)
        return self.whatever_is_claimed(operator)

    def whatever_is_claimed(self, operator: str) -> str:
        """Return in whose name this is done: what takes the beam away is not refused over a name."""
        if not self.identity.is_person and operator != NOT_GIVEN:
            behalf.act_for(operator)
        return self.name
