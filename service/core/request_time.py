"""When the request that is being processed arrived: host monotonic time [ns], which the engine process shares.

A command is as old as the request that contains it. The time is stamped before any part of the request waits for a
thread, a body or a database.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_arrived_ns: ContextVar[int | None] = ContextVar("arrived_ns", default=None)


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
