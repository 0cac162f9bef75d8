"""The two ways to a client: a WebSocket, and server-sent events."""

from collections.abc import Mapping

import anyio
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from service.stream.asking import Encoding, Form
from service.stream.buffers import cut_off, keep_small
from service.stream.counts import Why
from service.stream.spoken import Shape

MOST_SAID = 100
"""Messages that a client may send within a minute; none is listened to."""
SAID_S = 60.0
GOODBYE_S = 0.5
POLICY_VIOLATION, INTERNAL_ERROR, RESTART, TRY_AGAIN_LATER = 1008, 1011, 1012, 1013
CLOSE_CODES: Mapping[Why, int] = {
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


class SocketWire:
    """A WebSocket that was accepted."""

    def __init__(self, websocket: WebSocket, shape: Shape) -> None:
        self.shape = shape
        self._websocket = websocket
        self._kind = "text" if shape.encoding is Encoding.JSON else "bytes"
        keep_small(websocket.scope)

    async def send(self, payload: str | bytes) -> None:
        """Send a message of its own."""
        await self._websocket.send({"type": "websocket.send", self._kind: payload})

    async def listen(self) -> bool:
        """Wait until the client goes; nothing it says matters, but how often."""
        said, since_s = 0, anyio.current_time()
        while (await self._websocket.receive())["type"] != "websocket.disconnect":
            now_s = anyio.current_time()
            if now_s > since_s + SAID_S:
                said, since_s = 0, now_s
            said += 1
            if said > MOST_SAID:
                return False
        return True

    async def close(self, why: Why) -> None:
        """Say why; cut off who does not take even that."""
        with anyio.move_on_after(GOODBYE_S):
            await self._websocket.close(CLOSE_CODES[why], why)
            return
        cut_off(self._websocket.scope)


class EventsWire:
    """An answer that does not end: server-sent events."""

    def __init__(self, scope: Scope, receive: Receive, send: Send, form: Form) -> None:
        self.shape = Shape("sse", form, Encoding.JSON)
        self._scope = scope
        self._receive = receive
        self._send = send
        keep_small(scope)

    async def begin(self) -> None:
        """Send the head, and when to come back."""
        await self._send({"type": "http.response.start", "status": 200, "headers": list(EVENT_HEADERS)})
        await self.send(f"retry: {RETRY_MS}\n\n".encode())

    async def send(self, payload: str | bytes) -> None:
        """Send an event."""
        await self._send({"type": "http.response.body", "body": payload, "more_body": True})

    async def listen(self) -> bool:
        """Wait until the client goes."""
        while (await self._receive())["type"] != "http.disconnect":
            pass
        return True

    async def close(self, why: Why) -> None:
        """End the answer; cut off who does not take even that."""
        if why != "stalled":
            with anyio.move_on_after(GOODBYE_S):
                await self._send({"type": "http.response.body", "body": b"", "more_body": False})
                return
        cut_off(self._scope)
