"""For whom a machine acts: told in every audit row that its call leads to.

A context variable, set in the call's own context: what one request sets no other sees, and nobody on the way from the
router to the audit has to hand it on.
"""

from contextvars import ContextVar

_on_behalf_of: ContextVar[str | None] = ContextVar("tidegate_on_behalf_of", default=None)


def act_for(person: str) -> None:
    """Say for whom the rest of this call is."""
    _on_behalf_of.set(person)


def told() -> dict[str, object]:
    """Return what the audit adds to a row's detail."""
    person = _on_behalf_of.get()
    return {} if person is None else {"on_behalf_of": person}
