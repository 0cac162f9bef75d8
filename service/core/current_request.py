"""What is known of the request that is being processed: when it arrived, its id, and its session's.

The arrival is host monotonic time [ns], which the engine process shares. A command is as old as the request that
contains it. The time is stamped before any part of the request waits for a thread, a body or a database. The ids are
for the response's header and every line of the log.

All are context variables, so worker threads that answer requests inherit them; threads of our own have none.
"""

import re
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

_arrived_ns: ContextVar[int | None] = ContextVar("arrived_ns", default=None)
HEADER = "x-request-id"
GIVEN = re.compile(rb"[A-Za-z0-9._-]{1,64}")
"""A request id that a caller may choose; anything else could forge text in the log."""
IN_A_SESSION = re.compile(r"/api/v1/sessions/([0-9a-f]{32})(?:/|\Z)")
_request_id: ContextVar[str | None] = ContextVar("tidegate_request_id", default=None)
_session_id: ContextVar[str | None] = ContextVar("tidegate_session_id", default=None)


@contextmanager
def arriving_now() -> Iterator[None]:
    """Stamp the arrival for this context; worker threads started from it inherit the stamp."""
    stamp = _arrived_ns.set(time.monotonic_ns())
    try:
        yield
    finally:
        _arrived_ns.reset(stamp)


def request_time_ns() -> int:
    """Return when the current request arrived [ns]; the present time outside of a request."""
    arrived_ns = _arrived_ns.get()
    return time.monotonic_ns() if arrived_ns is None else arrived_ns


def request_id_of(given: Sequence[bytes]) -> str:
    """Return the one id that was given, if it is a valid one; else make one."""
    if len(given) == 1 and GIVEN.fullmatch(given[0]):
        return given[0].decode("ascii")
    return uuid.uuid4().hex


def begin_request(request_id: str, path: str) -> None:
    """Set the request and session of this context."""
    _request_id.set(request_id)
    found = IN_A_SESSION.match(path)
    _session_id.set(None if found is None else found.group(1))


def begin_session(session_id: str) -> None:
    """Set the session of this context; for threads and processes of a session."""
    _session_id.set(session_id)


def current_request_id() -> str | None:
    """Return the id of the current request; None outside of one."""
    return _request_id.get()


def current_session_id() -> str | None:
    """Return the id of the current session; None outside of one."""
    return _session_id.get()
