"""TLS that is begun and not gone on with, and noise where TLS is spoken."""

import asyncio
import ssl
import threading

import httpx2
import pytest
from fastapi import FastAPI, WebSocket

from service.core.settings.groups import ConnectionLimits
from service.monitoring.certificate import ServedCertificate
from service.web.server import make_server
from tests.support.access.tls_certificate import make_certificate
from tests.support.service.processes import free_port
from tests.support.waiting import eventually
from verification.attack.raw_connections import connection, read_all

LATEST_S = 8.0
UPGRADE = (
    b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)
GOODBYE = b"\x88\x80\0\0\0\0"
HELLO = bytes.fromhex("16030100f8010000f40303")


@pytest.fixture(scope="module")
def spoken(tmp_path_factory):
    """A server that speaks TLS, with the shortest patience there is; its port and certificate."""
    app = FastAPI()
    app.get("/healthz")(lambda: {"status": "ok"})
    app.state.hold_and_close_session = lambda: None

    @app.websocket("/live")
    async def live(websocket: WebSocket) -> None:
        await websocket.accept()
        await websocket.receive()

    cert, key = make_certificate(tmp_path_factory.mktemp("tls"))
    port = free_port()
    connection_limits = ConnectionLimits(handshake_s=1.0, header_s=1.0, write_s=1.0)
    server = make_server(
        app,
        host="127.0.0.1",
        port=port,
        certificate=ServedCertificate(cert, key),
        connection_limits=connection_limits,
    )
    thread = threading.Thread(target=lambda: asyncio.run(server.serve()))
    thread.start()
    eventually(lambda: server.started, within_s=20.0)
    yield port, cert
    server.should_exit = True
    thread.join(20.0)


@pytest.mark.parametrize("begun", [b"", HELLO], ids=["nothing", "half a hello"])
def test_who_begins_tls_and_goes_on_with_nothing_is_hung_up_on(spoken, begun):
    with connection(spoken[0]) as raw:
        raw.sendall(begun)
        reply = read_all(raw, LATEST_S)
    assert reply.is_closed
    assert reply.seconds < LATEST_S


@pytest.mark.parametrize(
    "noise", [b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", bytes(range(256)) * 64], ids=["plain HTTP", "noise"]
)
def test_what_is_no_tls_ends_at_once_and_the_next_is_served(spoken, noise):
    port, cert = spoken
    with connection(port) as raw:
        raw.sendall(noise)
        assert read_all(raw, LATEST_S).is_closed
    trusted = ssl.create_default_context(cafile=cert)
    assert httpx2.get(f"https://127.0.0.1:{port}/healthz", verify=trusted).status_code == 200


def test_a_client_that_is_silent_after_the_handshake_is_closed_with_the_reason(spoken):
    port, cert = spoken
    trusted = ssl.create_default_context(cafile=cert)
    with connection(port) as raw, trusted.wrap_socket(raw, server_hostname="127.0.0.1") as talk:
        reply = read_all(talk, LATEST_S)
    assert reply.status == 408
    assert reply.is_closed


def test_a_socket_that_does_not_end_its_tls_keeps_no_other_from_being_hung_up_on(spoken):
    port, cert = spoken
    trusted = ssl.create_default_context(cafile=cert)
    with connection(port) as raw, trusted.wrap_socket(raw, server_hostname="127.0.0.1") as leaving:
        leaving.sendall(UPGRADE)
        assert leaving.recv(65536).startswith(b"HTTP/1.1 101")
        leaving.sendall(GOODBYE)
        for _ in range(3):  # one of them waits when the connection above is overdue
            with connection(port) as silent, trusted.wrap_socket(silent, server_hostname="127.0.0.1") as talk:
                assert read_all(talk, LATEST_S).status == 408
