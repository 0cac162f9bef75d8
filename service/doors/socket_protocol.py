"""Uvicorn's socket protocol with a bound on what a client may say, and on how long it may leave us unheard."""

from __future__ import annotations

import asyncio
import logging
from asyncio.transports import BaseTransport
from typing import Any

from uvicorn.config import Config
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from service.doors.cutting import cut
from service.doors.visitors import VisitorBook

POLICY_VIOLATION = 1008
NOT_UTF8 = 1007
MOST_WAITING = 32
"""Messages that wait for the application: nobody has so much to say to a stream that one listens to."""
MOST_UNREAD_BYTES = 65_536
"""Beyond them pings are not answered any more; whatever else waits is the stream's to drop."""

_errors = logging.getLogger("uvicorn.error.doors")


class BoundedSocket(WebSocketsSansIOProtocol):
    """One socket; see the module."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        *,
        book: VisitorBook,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._book = book
        self._limits = book.limits
        self.logger = _errors
        self._unread_since_s: float | None = None
        self._closing_since_s: float | None = None

    def connection_made(self, transport: BaseTransport) -> None:
        """Take a connection over from HTTP."""
        super().connection_made(transport)
        self._book.becomes(transport, self)

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._book.leave(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes, but none once the connection is being closed."""
        if not self.transport.is_closing():
            super().data_received(data)

    def pause_writing(self) -> None:
        """Note from when on the client reads nothing."""
        self._unread_since_s = self.loop.time()
        super().pause_writing()

    def resume_writing(self) -> None:
        """Note that it reads."""
        self._unread_since_s = None
        super().resume_writing()

    def handle_ping(self) -> None:
        """Answer a ping; not one more to a client that has left many answers unread."""
        if self.transport.get_write_buffer_size() <= MOST_UNREAD_BYTES:
            super().handle_ping()
        else:
            self._book.refusals.add("not_read")
            cut(self.transport)

    def handle_parser_exception(self) -> None:
        """Close, as websockets has decided, and count it."""
        self._book.refusals.add("socket_frame")
        super().handle_parser_exception()

    def send_receive_event_to_app(self) -> None:
        """Hand a message to the application; not one that is no text, and not too many."""
        if self.queue.qsize() >= MOST_WAITING:
            self._fail(POLICY_VIOLATION, "too many messages", "socket_flood")
        elif self.curr_msg_data_type == "text" and not _is_utf8(b"".join(self.frames)):
            self._fail(NOT_UTF8, "no UTF-8", "socket_frame")
        else:
            super().send_receive_event_to_app()

    @property
    def waits(self) -> bool:
        """Whether it may be closed for another; a socket is in use for as long as it is open."""
        return False

    @property
    def is_known(self) -> bool:
        """Whether the guard knows who it is: it lets nobody else open one."""
        return True

    def look(self, now_s: float) -> str | None:
        """Cut off whoever reads nothing, and whoever does not take the rest of what was said to the end."""
        if self.transport.is_closing() and self._closing_since_s is None:
            self._closing_since_s = now_s
        for since_s in (self._unread_since_s, self._closing_since_s):
            if since_s is not None and now_s - since_s > self._limits.write_s:
                cut(self.transport)
                return "not_read"
        return None

    def leave(self) -> None:
        """Close at once."""
        cut(self.transport)

    def _fail(self, code: int, reason: str, what: str) -> None:
        """Say why, and close; the application hears of it as a disconnect."""
        self.frames = []
        if self.close_sent:
            return
        self._book.refusals.add(what)
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
