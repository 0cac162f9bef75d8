"""For whom a machine acts, and which part of its request body was ignored; added to each audit row of the request.

Context variables: each request has its own values, and the layers between router and audit need not pass them.
"""

from contextvars import ContextVar

_on_behalf_of: ContextVar[str | None] = ContextVar("tidegate_on_behalf_of", default=None)
_unread: ContextVar[str | None] = ContextVar("tidegate_unread", default=None)


def act_for(person: str) -> None:
    """Set the person on whose behalf the rest of this request acts."""
    _on_behalf_of.set(person)


def leave_unread(what: str) -> None:
    """Record which part of this request's body was ignored."""
    _unread.set(what)


def audit_fields() -> dict[str, object]:
    """Return the fields to add to an audit row's detail; empty if nothing was set."""
    found = {"on_behalf_of": _on_behalf_of.get(), "body_not_read": _unread.get()}
    return {name: value for name, value in found.items() if value is not None}
