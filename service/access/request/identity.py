"""The authenticated identity of a request, where the ASGI scope holds it, and the actor.

The actor is always the authenticated identity, never the operator named in the body. Hold, disarm and stop are never
refused because of their body. A person's name comes from the log-in; a machine's body may name the person for whom it
acts. Everything else in the body is ignored and reported in fixed words: the body's own text is never copied into the
audit row of a hold.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, NamedTuple, Protocol

from pydantic import TypeAdapter, ValidationError

from service.core.errors import OperatorMismatchError
from service.core.permissions import Permission
from service.core.schemas.base import Name
from service.storage.audit import chain

Kind = Literal["user", "key", "oidc", "machine", "screen"]
STATE = "tidegate.identity"
"""Scope key under which the guard stores the identity."""
RULE = "tidegate.rule"
"""Scope key under which the guard stores the matched rule: (method, path template)."""
NOT_GIVEN = ""
"""Value of `operator` in a request that omits it."""
OPERATOR = "operator"
NAME: TypeAdapter[str] = TypeAdapter(Name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """A person who has logged in (`user`, `oidc`), a machine (`key`, `machine`) or a paired screen (`screen`).

    ``name`` is the audit's actor. ``anchor`` names the record that must stay valid: the SHA-256 of a log-in's or a
    screen's token, or a key's id; None for
    machine tokens, which cannot be revoked. ``until`` is when the identity expires, None if it does not.
    """

    kind: Kind
    name: str
    permissions: frozenset[Permission]
    anchor: str | None = None
    must_change_password: bool = False
    until: datetime | None = None

    @property
    def is_person(self) -> bool:
        """Whether this is a person; a machine may act on behalf of one."""
        return self.kind in {"user", "oidc"}


class MachineVerifier(Protocol):
    """Verifies Bearer tokens that are not API keys of this service; from memory, without blocking."""

    def identify(self, token: str) -> Identity | None:
        """Return the machine's identity, or None if the token is not accepted."""


def identity_in(scope: Mapping[str, object]) -> Identity | None:
    """Return the identity that the guard stored; None on public paths."""
    found = scope.get(STATE)
    return found if isinstance(found, Identity) else None


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
            chain.act_for(operator)
        return self.name


class ClaimedOperator(NamedTuple):
    """The operator named in the body, and what part of the body was ignored; None if nothing was."""

    operator: str = NOT_GIVEN
    unread: str | None = None


def read_claim(body: bytes) -> ClaimedOperator:
    """Return the operator and what was ignored; never raises, whatever the body."""
    if not body:
        return ClaimedOperator()
    try:
        claim = json.loads(body)
    except (ValueError, RecursionError):
        return ClaimedOperator(unread="it is no JSON")
    if not isinstance(claim, dict):
        return ClaimedOperator(unread="it is no object")
    try:
        operator = NAME.validate_python(claim.get(OPERATOR, NOT_GIVEN), strict=True) if OPERATOR in claim else NOT_GIVEN
    except ValidationError:
        return ClaimedOperator(unread="its operator is no name")
    return ClaimedOperator(operator=operator, unread="it has other fields" if claim.keys() - {OPERATOR} else None)
