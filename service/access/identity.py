"""Who a request comes from, once that is known."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, Protocol

from service.access.permissions import Permission

Kind = Literal["user", "key", "oidc", "machine"]
STATE = "tidegate.identity"
"""Where the guard leaves the identity in the ASGI scope."""
RULE = "tidegate.rule"
"""Where the guard leaves the rule by which it let a request in: (method, path template)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """A person who has logged in (`user`, `oidc`) or a machine (`key`, `machine`); ``name`` is the audit's actor.

    ``anchor`` is what has to stay valid for the identity to: the hash of a log-in's token, a key's id, or None where
    whoever made the identity has nothing to take back; ``until`` is when it ends by itself.
    """

    kind: Kind
    name: str
    permissions: frozenset[Permission]
    anchor: str | None = None
    must_change_password: bool = False
    until: datetime | None = None

    @property
    def is_person(self) -> bool:
        """Whether it has a name of its own to act in; a machine acts for somebody."""
        return self.kind in {"user", "oidc"}


class MachineVerifier(Protocol):
    """Tells who a Bearer token that is not a key of ours belongs to; memory only, never waits."""

    def identify(self, token: str) -> Identity | None:
        """Return who it is, or None."""


def identity_in(scope: Mapping[str, object]) -> Identity | None:
    """Return who the guard let in, None where nobody had to say."""
    found = scope.get(STATE)
    return found if isinstance(found, Identity) else None
