"""The web server: one process, one worker, and a way out that holds the beam before it says goodbye to anyone."""

import socket
import ssl
from pathlib import Path

import anyio.to_thread
import uvicorn
from fastapi import FastAPI

LOG_LEVEL = "warning"
PING_S = 5.0
MAX_INCOMING_MESSAGE_BYTES = 4096
GOODBYE_S = 5


class CertificateError(Exception):
    """TLS was asked for, and cannot be spoken; for the person who starts the service."""


class BeamFirstServer(uvicorn.Server):
    """Uvicorn waits for its clients to go before the lifespan ends; the beam does not."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Hold the beam and close the session, then the connections, then everything else."""
        await anyio.to_thread.run_sync(self._app.state.hold_and_close_session)
        await super().shutdown(sockets)


def make_server(
    app: FastAPI, *, host: str, port: int, tls_cert: Path | None = None, tls_key: Path | None = None
) -> BeamFirstServer:
    """Make the server for the application; with a certificate it speaks TLS 1.2 or newer, and nothing else.

    Raises
    ------
    CertificateError
        The certificate or its key cannot be read, or they do not belong together.
    """
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
        ws="websockets-sansio",
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
    return BeamFirstServer(config, app)
