"""The web server: one process, one worker; on shutdown the beam is held before connections are closed."""

import asyncio
import signal
import socket
from collections.abc import Callable, Sequence
from functools import partial
from types import FrameType
from typing import cast

import anyio
import anyio.to_thread
import uvicorn
from fastapi import FastAPI

from service.core.settings.groups import ConnectionLimits
from service.monitoring.certificate import ServedCertificate
from service.web.connections.http_protocol import BoundedHttp
from service.web.connections.registry import ConnectionRegistry
from service.web.connections.socket_protocol import BoundedSocket
from service.web.middleware.requests import MAX_PLAN_BYTES
from service.web.shutdown import Leave, Shutdown

LOG_LEVEL = "warning"
PING_S = 5.0
MAX_INCOMING_MESSAGE_BYTES = 4096
GOODBYE_S = 1
"""Time for requests in progress and closing streams after the beam is held [s]."""
TLS_GOODBYE_S = 5.0


class BeamFirstServer(uvicorn.Server):
    """A uvicorn server that holds the beam at the stop signal, before uvicorn waits for its clients."""

    def __init__(
        self,
        config: uvicorn.Config,
        app: FastAPI,
        connection_limits: ConnectionLimits,
        leave: Leave | None = None,
        on_listening: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(config)
        self._app = app
        self._connection_limits = connection_limits
        self._on_listening = on_listening
        self._stop = Shutdown(self._hold_and_close, leave=leave)

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until a stop signal."""
        self._stop.watch()
        # Uvicorn raises the signal again once it has shut down; asked to stop and stopped is success.
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, _already_obeyed)
        super().run(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Hold the beam at once, in a separate thread; a second signal skips the orderly close of connections."""
        self._stop.ask()
        self.force_exit = self.force_exit or self.should_exit
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, with a time limit on TLS handshakes, for which uvicorn has no setting."""
        if self.config.is_ssl:
            loop = asyncio.get_running_loop()
            create_server = loop.create_server
            with_limits = partial(
                create_server,
                ssl_handshake_timeout=self._connection_limits.handshake_s,
                ssl_shutdown_timeout=TLS_GOODBYE_S,
            )
            loop.create_server = with_limits  # type: ignore[method-assign]
            try:
                await super().startup(sockets)
            finally:
                loop.create_server = create_server  # type: ignore[method-assign]
        else:
            await super().startup(sockets)
        if self.started:
            self._on_listening()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Wait until the beam is held and the session closed, then close the connections and the application."""
        self._stop.watch()
        self._stop.ask()
        # A separate limiter: this thread must not wait for those of requests.
        await anyio.to_thread.run_sync(self._stop.wait, limiter=anyio.CapacityLimiter(1))
        for stream in (getattr(self._app.state, name, None) for name in ("live", "coach")):
            if stream is not None:
                stream.shut_down()  # uvicorn would otherwise wait for the streams
        await super().shutdown(sockets)

    def _hold_and_close(self) -> None:
        house = getattr(self._app.state, "hold_and_close_session", None)
        if house is not None:  # else nothing has begun yet
            house()


def _already_obeyed(_number: int, _frame: FrameType | None) -> None:
    """Take the signal that uvicorn passes on after its shutdown."""


def make_server(
    app: FastAPI,
    *,
    host: str,
    port: int,
    certificate: ServedCertificate | None = None,
    connection_limits: ConnectionLimits | None = None,
    trusted_proxies: Sequence[str] = (),
    leave: Leave | None = None,
    on_listening: Callable[[], None] = lambda: None,
) -> BeamFirstServer:
    """Make the server for the application; with a certificate it speaks TLS 1.2 or newer, and nothing else.

    Parameters
    ----------
    connection_limits
        What a connection may take; from ``trusted_proxies`` there may be as many as there are.
    leave
        Ends the process where something does not let go of it in time; left out, it is waited for.
    on_listening
        Called on the event loop once the port accepts connections.
    """
    connection_limits = connection_limits or ConnectionLimits()
    registry = ConnectionRegistry(connection_limits, trusted_proxies=trusted_proxies)
    http = partial(BoundedHttp, registry=registry, max_body_bytes=MAX_PLAN_BYTES)
    config = uvicorn.Config(
        app,
        host=host,
        port=port,
        workers=1,
        log_level=LOG_LEVEL,
        log_config=None,  # its own would write down what an exception was about
        access_log=False,
        server_header=False,
        proxy_headers=False,
        # Uvicorn calls both, and asks no more of them; its types want classes.
        http=cast("type[asyncio.Protocol]", http),
        ws=cast("type[asyncio.Protocol]", partial(BoundedSocket, registry=registry)),
        timeout_keep_alive=round(connection_limits.keep_alive_s),
        ws_ping_interval=PING_S,
        ws_ping_timeout=PING_S,
        ws_max_size=MAX_INCOMING_MESSAGE_BYTES,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=GOODBYE_S,
        ssl_context_factory=None if certificate is None else lambda _config, _default: certificate.context,
    )
    config.load()
    return BeamFirstServer(config, app, connection_limits, leave, on_listening)
