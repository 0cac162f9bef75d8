"""The actor of a request: always the authenticated identity, never the operator named in the body."""

from dataclasses import dataclass

from service.access.request.identity import Identity
from service.core.errors import OperatorMismatchError
from service.storage.audit import on_behalf

NOT_GIVEN = ""
"""Value of `operator` in a request that omits it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RequestCaller:
    """The authenticated sender of a request."""

    identity: Identity

    @property
    def name(self) -> str:
        """The actor in audit rows."""
        return self.identity.name

    def checked_actor(self, operator: str) -> str:
        """Return the actor, after checking that a person's request does not name another operator.

        A machine may name the person for whom it acts; the audit row then carries both.

        Raises
        ------
        OperatorMismatchError
            A person's request names another operator, for example from a page opened before the log-in changed.
        """
        if self.identity.is_person and operator not in {NOT_GIVEN, self.name}:
            msg = f"{self.name} is logged in, and the call names another operator"
            bound = f"left out, or {self.name}"
            raise OperatorMismatchError(msg, field="operator", value=operator, bound=bound)
        return self.actor_unchecked(operator)

    def actor_unchecked(self, operator: str) -> str:
        """Return the actor without the check: hold, disarm and stop are never refused because of a name."""
        if not self.identity.is_person and operator != NOT_GIVEN:
            on_behalf.act_for(operator)
        return self.name
