"""The web server: one process, one worker, and a way out that holds the beam before it says goodbye to anyone."""

import asyncio
import signal
import socket
import ssl
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import FrameType
from typing import cast

import anyio
import anyio.to_thread
import uvicorn
from fastapi import FastAPI

from service.doors.http_protocol import BoundedHttp
from service.doors.limits import DoorLimits
from service.doors.socket_protocol import BoundedSocket
from service.doors.visitors import VisitorBook
from service.stopping import Leave, Stop

LOG_LEVEL = "warning"
PING_S = 5.0
MAX_INCOMING_MESSAGE_BYTES = 4096
GOODBYE_S = 1
"""How long what is under way may go on once the beam is held: an answer that is nearly out, or a stream's goodbye."""
TLS_GOODBYE_S = 5.0
MAX_BODY_BYTES = 1_048_576


class CertificateError(Exception):
    """TLS was asked for, and cannot be spoken; for the person who starts the service."""


class BeamFirstServer(uvicorn.Server):
    """Uvicorn waits for its clients to go before the lifespan ends; the beam does not."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, doors: DoorLimits, leave: Leave | None = None) -> None:
        super().__init__(config)
        self._app = app
        self._doors = doors
        self._stop = Stop(self._hold_and_close, leave=leave)

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until told to stop."""
        self._stop.watch()
        # Uvicorn raises the signal again once it has shut down; asked to stop and stopped is success.
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, _already_obeyed)
        super().run(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Have the beam held at once, by a thread that waits for nothing else; asked again, say no goodbyes."""
        self._stop.ask()
        self.force_exit = self.force_exit or self.should_exit
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen; whoever begins TLS and goes on with nothing is cut off, which uvicorn has no setting for."""
        if self.config.is_ssl:
            loop = asyncio.get_running_loop()
            patient = loop.create_server
            quick = partial(patient, ssl_handshake_timeout=self._doors.handshake_s, ssl_shutdown_timeout=TLS_GOODBYE_S)
            loop.create_server = quick  # type: ignore[method-assign]
            try:
                await super().startup(sockets)
            finally:
                loop.create_server = patient  # type: ignore[method-assign]
        else:
            await super().startup(sockets)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Wait until the beam is held and the session closed; then end the connections, then everything else."""
        self._stop.watch()
        self._stop.ask()
        # A thread of its own: however many requests wait for theirs, this waits for none of them.
        await anyio.to_thread.run_sync(self._stop.wait, limiter=anyio.CapacityLimiter(1))
        live = getattr(self._app.state, "live", None)
        if live is not None:
            live.leave()  # streams end by themselves instead of being waited for
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
    tls_cert: Path | None = None,
    tls_key: Path | None = None,
    doors: DoorLimits | None = None,
    trusted_proxies: Sequence[str] = (),
    max_body_bytes: int = MAX_BODY_BYTES,
    leave: Leave | None = None,
) -> BeamFirstServer:
    """Make the server for the application; with a certificate it speaks TLS 1.2 or newer, and nothing else.

    Parameters
    ----------
    doors
        What a connection may take; from ``trusted_proxies`` there may be as many as there are.
    max_body_bytes
        The largest body that any call takes; here it bounds the bytes on the wire, in the application the body.
    leave
        Ends the process where something does not let go of it in time; left out, it is waited for.

    Raises
    ------
    CertificateError
        The certificate or its key cannot be read, or they do not belong together.
    """
    doors = doors or DoorLimits()
    book = VisitorBook(doors, trusted_proxies=trusted_proxies)
    http = partial(BoundedHttp, book=book, max_body_bytes=max_body_bytes)
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
        ws=cast("type[asyncio.Protocol]", partial(BoundedSocket, book=book)),
        timeout_keep_alive=round(doors.keep_alive_s),
        ws_ping_interval=PING_S,
        ws_ping_timeout=PING_S,
        ws_max_size=MAX_INCOMING_MESSAGE_BYTES,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=GOODBYE_S,
        ssl_certfile=tls_cert,
        ssl_keyfile=tls_key,
    )
    try:
        config.load()
    except (OSError, ssl.SSLError) as error:
        msg = f"{tls_cert} and {tls_key} cannot be used for TLS: {error.strerror or error}"
        raise CertificateError(msg) from error
    if config.ssl is not None:
        config.ssl.minimum_version = ssl.TLSVersion.TLSv1_2
    return BeamFirstServer(config, app, doors, leave)
