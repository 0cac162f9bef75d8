"""Uvicorn's HTTP protocol with a bound on everything that a client may let the server wait for."""

from __future__ import annotations

import asyncio
import logging
import sys
from typing import Any

import h11
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from service.access.identity import STATE
from service.doors.cutting import cut
from service.doors.refusals import phrase_of, problem_answer
from service.doors.visitors import VisitorBook
from service.doors.wire import StrictConnection

WIRE_FACTOR = 8
"""How many bytes a body may take on the wire for one of its own: chunks of one byte take six."""

MOST_AHEAD_BYTES = 65_536
"""Of further requests that are sent before the one under way is answered."""

TRANSPORT = "tidegate.transport"
"""Where the application finds the connection in a scope's state: the stream looks at what waits in it."""

# What uvicorn warns of (bad requests, unknown upgrades) is counted here instead, without a line for each.
_errors = logging.getLogger("uvicorn.error.doors")
_errors.setLevel(logging.ERROR)


class BoundedHttp(H11Protocol):
    """One HTTP connection; see the module."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        *,
        book: VisitorBook,
        max_body_bytes: int,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._book = book
        self._limits = book.limits
        self._max_wire_bytes = self._limits.max_header_bytes + WIRE_FACTOR * max_body_bytes
        self.logger = _errors
        self.conn = StrictConnection(self._limits)
        self._head_since_s: float | None = self.loop.time()
        self._unread_since_s: float | None = None
        self._closing_since_s: float | None = None
        self._wire_bytes = 0

    # What the server and the transport call

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, if there is a place."""
        super().connection_made(transport)
        self.app_state = {**self.app_state, TRANSPORT: transport}
        self._head_since_s = self.loop.time()
        if not self._book.enter(transport, self, self.client[0] if self.client else None):
            self._answer_and_close(503, "every connection is in use: try again")

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._book.leave(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes; none any more of a request that takes too many, or of a connection that was refused."""
        if self.transport.is_closing():
            return
        if self._head_since_s is None and self._is_between_requests:
            self._head_since_s = self.loop.time()
            self._wire_bytes = 0
        self._wire_bytes += len(data)
        if self._wire_bytes > self._max_wire_bytes:
            self._refuse(400, "the body takes far more bytes on its way than it has")
            return
        super().data_received(data)
        if self._is_between_requests:
            self._wait_anew_behind_late_body()
            return
        if self._head_since_s is not None:  # a call's body comes with its head or within moments
            self._head_since_s = None
            self._book.stirs(self.transport)
        # Uvicorn stops reading ahead of a request, and reads on whenever the application asks whether anybody left.
        if not self.cycle.more_body and len(self.conn.trailing_data[0]) > MOST_AHEAD_BYTES:
            self._book.refusals.add("too_far_ahead")
            cut(self.transport)

    def pause_writing(self) -> None:
        """Note from when on the client reads nothing."""
        self._unread_since_s = self.loop.time()
        self._book.stirs(self.transport)
        super().pause_writing()

    def resume_writing(self) -> None:
        """Note that it reads."""
        self._unread_since_s = None
        super().resume_writing()

    def on_response_complete(self) -> None:
        """Wait for the next request, from its first byte on not for long."""
        self._wire_bytes = 0
        self._book.stirs(self.transport)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand over to the socket, which counts as in use."""
        self._head_since_s = None
        super().handle_websocket_upgrade(event)

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002 - uvicorn's words
        """Answer what h11 or we refused, with the status that fits and a problem."""
        error = sys.exception()
        status = error.error_status_hint if isinstance(error, h11.RemoteProtocolError) else 400
        self._refuse(status, "the request does not keep to HTTP/1.1, or to the bounds of this service")

    # What the book calls

    @property
    def waits(self) -> bool:
        """Whether no request is under way, or its body is not here and nothing was answered, or nothing is read."""
        if self._is_between_requests or self._unread_since_s is not None:
            return True
        return self.cycle.more_body and not self.cycle.response_started

    @property
    def is_known(self) -> bool:
        """Whether the guard knows whose request is under way: it says so before anything of the body is read."""
        return not self._is_between_requests and self.cycle.scope.get(STATE) is not None

    def look(self, now_s: float) -> str | None:
        """End what is overdue."""
        if self.transport.is_closing():
            return self._look_at_closing(now_s)
        if self._is_over(self._unread_since_s, self._limits.write_s, now_s):
            cut(self.transport)
            return "not_read"
        if self._is_over(self._head_since_s, self._limits.header_s, now_s):
            self._answer_and_close(408, "the headers took too long")
            return "request_timeout"
        return None

    def leave(self) -> None:
        """Close at once."""
        cut(self.transport)

    # Own

    @property
    def _is_between_requests(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    @staticmethod
    def _is_over(since_s: float | None, limit_s: float, now_s: float) -> bool:
        return since_s is not None and now_s - since_s > limit_s

    def _wait_anew_behind_late_body(self) -> None:
        """Wait as after any answer where its request's body came behind it, and nothing of a further head.

        The further head's time would run from that body on, and its end would be told as the answer to who asks next.
        """
        if self.cycle is None or self.conn.their_state is not h11.IDLE or self.conn.trailing_data[0]:
            return
        self._head_since_s = None
        self._unset_keepalive_if_required()
        self.timeout_keep_alive_task = self.loop.call_later(self.timeout_keep_alive, self.timeout_keep_alive_handler)

    def _look_at_closing(self, now_s: float) -> str | None:
        """Cut off whoever does not take the rest: a closed connection stays until it has."""
        if self._closing_since_s is None:
            self._closing_since_s = now_s
        elif self._is_over(self._closing_since_s, self._limits.write_s, now_s):
            cut(self.transport)
        return None

    def _refuse(self, status: int, detail: str) -> None:
        code = self._answer_and_close(status, detail)
        self._book.refusals.add(code)

    def _answer_and_close(self, status: int, detail: str) -> str:
        """Answer with a problem where nothing was answered yet, and close; returns the code."""
        code, headers, body = problem_answer(status, detail)
        if self.conn.our_state in {h11.IDLE, h11.SEND_RESPONSE}:
            response = h11.Response(status_code=status, headers=headers, reason=phrase_of(status))
            for event in (response, h11.Data(data=body), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self._head_since_s = None
        if not self._is_between_requests:  # the application hears that nobody listens any more
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self.transport.close()
        return code
