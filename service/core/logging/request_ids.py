"""Which request, and which session, something belongs to: told in every answer's header and in every line of the log.

Kept in context variables: they go along into the worker threads that answer requests, and a thread of our own has none.
"""

import re
import uuid
from collections.abc import Sequence
from contextvars import ContextVar

HEADER = "x-request-id"
GIVEN = re.compile(rb"[A-Za-z0-9._-]{1,64}")
"""What a caller may call its request; anything else might be meant for whoever reads the log."""
IN_A_SESSION = re.compile(r"/api/v1/sessions/([0-9a-f]{32})(?:/|\Z)")

_request_id: ContextVar[str | None] = ContextVar("tidegate_request_id", default=None)
_session_id: ContextVar[str | None] = ContextVar("tidegate_session_id", default=None)


def request_id_of(given: Sequence[bytes]) -> str:
    """Return the one id that was given, if it is a valid one; else make one."""
    if len(given) == 1 and GIVEN.fullmatch(given[0]):
        return given[0].decode("ascii")
    return uuid.uuid4().hex


def begin_request(request_id: str, path: str) -> None:
    """Let everything that is done from here on in this context belong to the request."""
    _request_id.set(request_id)
    found = IN_A_SESSION.match(path)
    _session_id.set(None if found is None else found.group(1))


def begin_session(session_id: str) -> None:
    """Let everything that is logged from here on in this context belong to the session: for threads and processes."""
    _session_id.set(session_id)


def current_request_id() -> str | None:
    """Return the request that this is done for; None outside of any."""
    return _request_id.get()


def current_session_id() -> str | None:
    """Return the session that this is done for; None outside of any."""
    return _session_id.get()
