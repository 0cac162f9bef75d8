"""The authenticated identity of a request, and where the ASGI scope holds it."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, Protocol

from service.core.permissions import Permission

Kind = Literal["user", "key", "oidc", "machine", "screen"]
STATE = "tidegate.identity"
"""Scope key under which the guard stores the identity."""
RULE = "tidegate.rule"
"""Scope key under which the guard stores the matched rule: (method, path template)."""


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
