"""For whom a machine acts, and what of its call was not read: told in every audit row that the call leads to.

A context variable, set in the call's own context: what one request sets no other sees, and nobody on the way from the
router to the audit has to hand it on.
"""

from contextvars import ContextVar

_on_behalf_of: ContextVar[str | None] = ContextVar("tidegate_on_behalf_of", default=None)
_unread: ContextVar[str | None] = ContextVar("tidegate_unread", default=None)


def act_for(person: str) -> None:
    """Say for whom the rest of this call is."""
    _on_behalf_of.set(person)


def leave_unread(what: str) -> None:
    """Say what of this call's body was passed over."""
    _unread.set(what)


def told() -> dict[str, object]:
    """Return what the audit adds to a row's detail."""
    found = {"on_behalf_of": _on_behalf_of.get(), "body_not_read": _unread.get()}
    return {name: value for name, value in found.items() if value is not None}
