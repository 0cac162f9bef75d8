"""Uvicorn's HTTP protocol with a time or size limit on everything that a client can delay."""

from __future__ import annotations

import asyncio
import logging
import re
import sys
from typing import Any

import h11
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from service.access.request.identity import STATE
from service.core.settings.groups import ConnectionLimits
from service.web.connections.refusals import abort, phrase_of, problem_answer
from service.web.connections.registry import ConnectionRegistry

BAD_REQUEST, URL_TOO_LONG, HEADERS_TOO_LARGE = 400, 414, 431
_END = b"\r\n\r\n"
_BARE = re.compile(rb"(?<!\r)\n|\r(?!\n|\Z)|\0")
_FOLDED = re.compile(rb"\r\n[ \t]")
_TOKEN = re.compile(rb"[!#$%&'*+.^_`|~0-9A-Za-z-]{1,20}")
WIRE_FACTOR = 8
"""Largest ratio of bytes on the wire to bytes of the body: chunks of one byte take six."""
MOST_AHEAD_BYTES = 65_536
"""Limit of pipelined requests [bytes] before the request in progress is answered."""
TRANSPORT = "tidegate.transport"
"""Key of the connection in a scope's state; the live stream limits its send buffer."""
# What uvicorn warns of (bad requests, unknown upgrades) is counted here instead, without a line for each.
_errors = logging.getLogger("uvicorn.error.connections")


# Strict HTTP/1.1: requests that two parsers could read differently are refused.
#
# h11 is lenient where RFC 9112 allows it (bare line feeds, folded headers, Transfer-Encoding with Content-Length). A
# proxy in front may be lenient in another way, and then both disagree where a request ends (request smuggling).
class StrictConnection(h11.Connection):
    """An h11 server connection with additional checks."""

    def __init__(self, limits: ConnectionLimits) -> None:
        super().__init__(h11.SERVER, limits.max_header_bytes)
        self._limits = limits

    def next_event(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        """Return the next event; raise RemoteProtocolError with the status of the answer."""
        if self.their_state is h11.IDLE and self.our_state is h11.IDLE:
            self._check_head(self.trailing_data[0])
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._check_request(event)
        return event

    def _check_head(self, waiting: bytes) -> None:
        """Check the received bytes of a request's head."""
        head, end, _ = waiting.partition(_END)
        if not end and len(head) > self._limits.max_header_bytes:
            line = head.partition(b"\r\n")[0]
            is_url = len(line) > self._limits.max_url_bytes
            raise _refusal("the URL", URL_TOO_LONG) if is_url else _refusal("the headers", HEADERS_TOO_LARGE)
        if _BARE.search(head):
            raise _refusal("a line that does not end with CR LF", BAD_REQUEST)
        if _FOLDED.search(head):
            raise _refusal("a folded header", BAD_REQUEST)

    def _check_request(self, request: h11.Request) -> None:
        names = [name for name, _ in request.headers]
        if len(request.target) > self._limits.max_url_bytes:
            raise _refusal("the URL", URL_TOO_LONG)
        head_bytes = sum(len(name) + len(value) + 4 for name, value in request.headers) + len(request.target)
        if len(names) > self._limits.max_headers or head_bytes > self._limits.max_header_bytes:
            raise _refusal("the headers", HEADERS_TOO_LARGE)
        if not request.target.startswith(b"/"):
            raise _refusal("a target that is not a path", BAD_REQUEST)
        if b"transfer-encoding" in names and (b"content-length" in names or request.http_version != b"1.1"):
            raise _refusal("Transfer-Encoding together with Content-Length", BAD_REQUEST)
        if not _TOKEN.fullmatch(request.method):
            raise _refusal("the method", BAD_REQUEST)


def _refusal(what: str, status: int) -> h11.RemoteProtocolError:
    return h11.RemoteProtocolError(what, error_status_hint=status)


_errors.setLevel(logging.ERROR)


class BoundedHttp(H11Protocol):
    """One HTTP connection, with limits on waiting time and size."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        *,
        registry: ConnectionRegistry,
        max_body_bytes: int,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._registry = registry
        self._limits = registry.limits
        self._max_wire_bytes = self._limits.max_header_bytes + WIRE_FACTOR * max_body_bytes
        self.logger = _errors
        self.conn = StrictConnection(self._limits)
        self._head_since_s: float | None = self.loop.time()
        self._unread_since_s: float | None = None
        self._closing_since_s: float | None = None
        self._wire_bytes = 0

    # What the server and the transport call

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection if there is room."""
        super().connection_made(transport)
        self.app_state = {**self.app_state, TRANSPORT: transport}
        self._head_since_s = self.loop.time()
        if not self._registry.add(transport, self, self.client[0] if self.client else None):
            self._answer_and_close(503, "All connections are in use. Try again.")

    def connection_lost(self, exc: Exception | None) -> None:
        """Release the connection."""
        self._registry.remove(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Process received bytes; discard them if the request is too large or the connection was refused."""
        if self.transport.is_closing():
            return
        if self._head_since_s is None and self._is_between_requests:
            self._head_since_s = self.loop.time()
            self._wire_bytes = 0
        self._wire_bytes += len(data)
        if self._wire_bytes > self._max_wire_bytes:
            self._refuse(400, "The chunked body has too much overhead.")
            return
        super().data_received(data)
        if self._is_between_requests:
            self._reset_after_late_body()
            return
        if self._head_since_s is not None:  # a call's body comes with its head or within moments
            self._head_since_s = None
            self._registry.note_waiting(self.transport)
        # Uvicorn stops reading ahead of a request, and resumes whenever the application checks for a disconnect.
        if not self.cycle.more_body and len(self.conn.trailing_data[0]) > MOST_AHEAD_BYTES:
            self._registry.refusals.add("too_far_ahead")
            abort(self.transport)

    def pause_writing(self) -> None:
        """Note when the client stopped reading."""
        self._unread_since_s = self.loop.time()
        self._registry.note_waiting(self.transport)
        super().pause_writing()

    def resume_writing(self) -> None:
        """Note that the client reads again."""
        self._unread_since_s = None
        super().resume_writing()

    def on_response_complete(self) -> None:
        """Start to wait for the next request; from its first byte the header time limit applies."""
        self._wire_bytes = 0
        self._registry.note_waiting(self.transport)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Switch to the WebSocket protocol; an open socket counts as in use."""
        self._head_since_s = None
        super().handle_websocket_upgrade(event)

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002 - uvicorn's words
        """Answer a request that h11 or this protocol refused, with a status and a problem."""
        error = sys.exception()
        status = error.error_status_hint if isinstance(error, h11.RemoteProtocolError) else 400
        self._refuse(status, "The request violates HTTP/1.1 or the limits of this service.")

    # Called by the registry

    @property
    def waits(self) -> bool:
        """Whether the server waits for the client: for a request, for the rest of its body, or for it to read."""
        if self._is_between_requests or self._unread_since_s is not None:
            return True
        return self.cycle.more_body and not self.cycle.response_started

    @property
    def is_authenticated(self) -> bool:
        """Whether the guard has authenticated the request in progress; it does before the body is read."""
        return not self._is_between_requests and self.cycle.scope.get(STATE) is not None

    def check(self, now_s: float) -> str | None:
        """End the connection if a time limit is over."""
        if self.transport.is_closing():
            return self._check_closing(now_s)
        if self._is_over(self._unread_since_s, self._limits.write_s, now_s):
            abort(self.transport)
            return "not_read"
        if self._is_over(self._head_since_s, self._limits.header_s, now_s):
            self._answer_and_close(408, "The headers took too long.")
            return "request_timeout"
        return None

    def abort(self) -> None:
        """Abort the connection."""
        abort(self.transport)

    # Own

    @property
    def _is_between_requests(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    @staticmethod
    def _is_over(since_s: float | None, limit_s: float, now_s: float) -> bool:
        return since_s is not None and now_s - since_s > limit_s

    def _reset_after_late_body(self) -> None:
        """Return to the idle state if the body arrived after its answer and no further request has started.

        Otherwise the header time limit would run from that body, and its expiry would answer the next request.
        """
        if self.cycle is None or self.conn.their_state is not h11.IDLE or self.conn.trailing_data[0]:
            return
        self._head_since_s = None
        self._unset_keepalive_if_required()
        self.timeout_keep_alive_task = self.loop.call_later(self.timeout_keep_alive, self.timeout_keep_alive_handler)

    def _check_closing(self, now_s: float) -> str | None:
        """Abort if the client does not read the rest: a closed connection stays open until it does."""
        if self._closing_since_s is None:
            self._closing_since_s = now_s
        elif self._is_over(self._closing_since_s, self._limits.write_s, now_s):
            abort(self.transport)
        return None

    def _refuse(self, status: int, detail: str) -> None:
        code = self._answer_and_close(status, detail)
        self._registry.refusals.add(code)

    def _answer_and_close(self, status: int, detail: str) -> str:
        """Send a problem if no answer was started, and close; return the code."""
        code, headers, body = problem_answer(status, detail)
        if self.conn.our_state in {h11.IDLE, h11.SEND_RESPONSE}:
            response = h11.Response(status_code=status, headers=headers, reason=phrase_of(status))
            for event in (response, h11.Data(data=body), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self._head_since_s = None
        if not self._is_between_requests:  # report the disconnect to the application
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self.transport.close()
        return code
