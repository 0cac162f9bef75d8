"""Uvicorn's WebSocket protocol with limits on the client's messages and on the time without reading."""

from __future__ import annotations

import asyncio
import logging
from asyncio.transports import BaseTransport
from typing import Any

from uvicorn.config import Config
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from service.web.connections.refusals import abort
from service.web.connections.registry import ConnectionRegistry

POLICY_VIOLATION = 1008
NOT_UTF8 = 1007
MOST_WAITING = 32
"""Limit of queued client messages; clients of the stream have no reason to send any."""
MOST_UNREAD_BYTES = 65_536
"""Limit of unread bytes [bytes] beyond which pings are not answered; the stream drops its own messages."""

_errors = logging.getLogger("uvicorn.error.connections")


class BoundedSocket(WebSocketsSansIOProtocol):
    """One WebSocket, with limits on messages and waiting time."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        *,
        registry: ConnectionRegistry,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._registry = registry
        self._limits = registry.limits
        self.logger = _errors
        self._unread_since_s: float | None = None
        self._closing_since_s: float | None = None

    def connection_made(self, transport: BaseTransport) -> None:
        """Take over a connection from the HTTP protocol."""
        super().connection_made(transport)
        self._registry.replace(transport, self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Release the connection."""
        self._registry.remove(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Process received bytes; discard them while the connection is closing."""
        if not self.transport.is_closing():
            super().data_received(data)

    def pause_writing(self) -> None:
        """Note when the client stopped reading."""
        self._unread_since_s = self.loop.time()
        super().pause_writing()

    def resume_writing(self) -> None:
        """Note that the client reads again."""
        self._unread_since_s = None
        super().resume_writing()

    def handle_ping(self) -> None:
        """Answer a ping, unless the client has too many unread answers."""
        if self.transport.get_write_buffer_size() <= MOST_UNREAD_BYTES:
            super().handle_ping()
        else:
            self._registry.refusals.add("not_read")
            abort(self.transport)

    def handle_parser_exception(self) -> None:
        """Close as the websockets library decided, and count it."""
        self._registry.refusals.add("socket_frame")
        super().handle_parser_exception()

    def send_receive_event_to_app(self) -> None:
        """Pass a message to the application; refuse invalid UTF-8 and too many messages."""
        if self.queue.qsize() >= MOST_WAITING:
            self._fail(POLICY_VIOLATION, "too many messages", "socket_flood")
        elif self.curr_msg_data_type == "text" and not _is_utf8(b"".join(self.frames)):
            self._fail(NOT_UTF8, "not UTF-8", "socket_frame")
        else:
            super().send_receive_event_to_app()

    @property
    def waits(self) -> bool:
        """Whether the connection may be replaced; an open socket is always in use."""
        return False

    @property
    def is_authenticated(self) -> bool:
        """True: the guard admits authenticated clients only."""
        return True

    def check(self, now_s: float) -> str | None:
        """Abort if the client does not read, or does not complete the closing handshake."""
        if self.transport.is_closing() and self._closing_since_s is None:
            self._closing_since_s = now_s
        for since_s in (self._unread_since_s, self._closing_since_s):
            if since_s is not None and now_s - since_s > self._limits.write_s:
                abort(self.transport)
                return "not_read"
        return None

    def abort(self) -> None:
        """Abort the connection."""
        abort(self.transport)

    def _fail(self, code: int, reason: str, what: str) -> None:
        """Close with a reason; the application receives a disconnect."""
        self.frames = []
        if self.close_sent:
            return
        self._registry.refusals.add(what)
        self.conn.fail(code, reason)
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": reason})
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.transport.close()


def _is_utf8(content: bytes) -> bool:
    try:
        content.decode()
    except UnicodeDecodeError:
        return False
    return True
