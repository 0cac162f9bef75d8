"""The two kinds of connection to a client: WebSocket and server-sent events."""

import asyncio
import contextlib
import socket
from collections.abc import Mapping
from typing import Any, cast

import anyio
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from service.web.stream.encoding import Form, Shape
from service.web.stream.metrics import CloseReason

TRANSPORT = "tidegate.transport"
"""Key of the connection's transport in the state of the ASGI scope."""
SYSTEM_BUFFER_BYTES = 16_384
"""Linux doubles the value and includes its bookkeeping."""
MOST_UNSENT_BYTES = 1
"""High-water mark at which a transport pauses its writer. Not 0: asyncio's TLS transport pauses at ``size >= high``, an
empty buffer included, and checks again only at the next write or read, so that a paused stream stays paused."""
MAX_CLIENT_MESSAGES = 100
"""Largest number of messages that a client may send per minute; all are ignored."""
CLIENT_MESSAGE_PERIOD_S = 60.0
CLOSE_TIMEOUT_S = 0.5
ABNORMAL_CLOSURE = 1006
POLICY_VIOLATION, INTERNAL_ERROR, RESTART, TRY_AGAIN_LATER = 1008, 1011, 1012, 1013
CLOSE_CODES: Mapping[CloseReason, int] = {
    "stalled": TRY_AGAIN_LATER,
    "full": TRY_AGAIN_LATER,
    "not_logged_in": POLICY_VIOLATION,
    "chatty": POLICY_VIOLATION,
    "failed": INTERNAL_ERROR,
    "leaving": RESTART,
}
RETRY_MS = 1000
EVENT_HEADERS = (
    (b"content-type", b"text/event-stream"),
    (b"cache-control", b"no-store"),
    (b"x-accel-buffering", b"no"),
)


# Small send buffers for live connections, so that a slow client gets the newest message and no backlog.
#
# Linux would buffer megabytes for a client that does not read. `keep_small` limits the kernel's buffer to about ten
# messages and asyncio's to the one that did not fit: the next send waits until that one is sent.
#
# Over TLS asyncio has two buffers: encrypted bytes of the TLS transport wait for the socket's transport, which has a
# buffer of its own (64 KiB by default). Both are made small; one message may then wait in each.
def transport_of(scope: Mapping[str, Any]) -> asyncio.Transport | None:
    """Return the connection's transport; None if another server runs the application."""
    return cast("asyncio.Transport | None", scope.get("state", {}).get(TRANSPORT))


def keep_small(scope: Mapping[str, Any]) -> None:
    """Limit every buffer between the application and this client."""
    transport = transport_of(scope)
    if transport is None:
        return
    transport.set_write_buffer_limits(high=MOST_UNSENT_BYTES)
    below = _below_tls(transport)
    if below is not None:
        below.set_write_buffer_limits(high=MOST_UNSENT_BYTES)
    connection = transport.get_extra_info("socket")
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SYSTEM_BUFFER_BYTES)


def abort(scope: Mapping[str, Any]) -> None:
    """Abort the connection and discard unsent data."""
    transport = transport_of(scope)
    if transport is not None:
        transport.abort()


def _below_tls(transport: asyncio.Transport) -> asyncio.Transport | None:
    """Return the socket's transport below a TLS transport (an asyncio internal); None without TLS."""
    protocol = getattr(transport, "_ssl_protocol", None)
    return cast("asyncio.Transport | None", getattr(protocol, "_transport", None))


class SocketConnection:
    """An accepted WebSocket."""

    def __init__(self, websocket: WebSocket, shape: Shape) -> None:
        self.shape = shape
        self._websocket = websocket
        keep_small(websocket.scope)

    async def send(self, payload: str | bytes) -> None:
        """Send one message; raise WebSocketDisconnect when the server has closed the socket.

        The server closes it by itself after a protocol error of the client, before `listen` sees the disconnection.
        """
        try:
            await self._websocket.send({"type": "websocket.send", "text": payload})
        except RuntimeError as error:
            raise WebSocketDisconnect(ABNORMAL_CLOSURE) from error

    async def listen(self) -> bool:
        """Wait until the client disconnects; its messages are ignored and counted."""
        received, since_s = 0, anyio.current_time()
        while (await self._websocket.receive())["type"] != "websocket.disconnect":
            now_s = anyio.current_time()
            if now_s > since_s + CLIENT_MESSAGE_PERIOD_S:
                received, since_s = 0, now_s
            received += 1
            if received > MAX_CLIENT_MESSAGES:
                return False
        return True

    async def close(self, why: CloseReason) -> None:
        """Close with the reason; abort if the client does not read it."""
        with (
            anyio.move_on_after(CLOSE_TIMEOUT_S),
            contextlib.suppress(RuntimeError),
        ):  # the server may have closed it already
            await self._websocket.close(CLOSE_CODES[why], why)
            return
        abort(self._websocket.scope)


class EventsConnection:
    """A response of server-sent events."""

    def __init__(self, scope: Scope, receive: Receive, send: Send, form: Form) -> None:
        self.shape = Shape("sse", form)
        self._scope = scope
        self._receive = receive
        self._send = send
        keep_small(scope)

    async def begin(self) -> None:
        """Send the headers and the delay for reconnections."""
        await self._send({"type": "http.response.start", "status": 200, "headers": list(EVENT_HEADERS)})
        await self.send(f"retry: {RETRY_MS}\n\n".encode())

    async def send(self, payload: str | bytes) -> None:
        """Send an encoded event."""
        await self._send({"type": "http.response.body", "body": payload, "more_body": True})

    async def listen(self) -> bool:
        """Wait until the client disconnects."""
        while (await self._receive())["type"] != "http.disconnect":
            pass
        return True

    async def close(self, why: CloseReason) -> None:
        """End the response; abort if the client does not read."""
        if why != "stalled":
            with anyio.move_on_after(CLOSE_TIMEOUT_S):
                await self._send({"type": "http.response.body", "body": b"", "more_body": False})
                return
        abort(self._scope)
