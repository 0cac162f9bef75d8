"""When a call arrived: stamped before anything of it waits for a thread, a body or a database.

A command is as old as the call that asks for it. Host monotonic time [ns], which the engine's process shares.
"""

import time
from contextvars import ContextVar

from starlette.types import ASGIApp, Receive, Scope, Send

_arrived_ns: ContextVar[int | None] = ContextVar("arrived_ns", default=None)


class Arrival:
    """The outermost of the middleware."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Stamp a call; its route's thread is given the same context."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        stamped = _arrived_ns.set(time.monotonic_ns())
        try:
            await self._app(scope, receive, send)
        finally:
            _arrived_ns.reset(stamped)


def asked_ns() -> int:
    """Return when the call that is worked on arrived; now, where the service asks by itself."""
    arrived_ns = _arrived_ns.get()
    return time.monotonic_ns() if arrived_ns is None else arrived_ns
