"""A real web server with real sockets on a fake engine: the frames are the test's."""

import asyncio
import contextlib
import json
import socket
import ssl
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import httpx2
from websockets.sync.client import ClientConnection, connect

from engine.core.gate_state import GateState
from service.access.login.cookies import CookieScope
from service.core.settings.settings import Settings
from service.web.app import create_app
from service.web.server import BeamFirstServer, make_server
from service.web.stream.hub import LiveHub
from tests.support.service.accounts import headers_of, open_login
from tests.support.service.api_calls import make_calibration, make_session_body
from tests.support.service.fake_engine import FakeEngine, FakeRunning
from tests.support.service.processes import free_port
from tests.support.waiting import PATIENCE_S, eventually

BIG = "x" * 20_000
"""An operator's name that makes each sample a message of 20 kB: few of them fill every buffer."""
LONGEST_FRAME_HEAD = 10
"""Bytes of a WebSocket frame before its content; every message of the stream is longer."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Served:
    """The service as a client sees it, and the engine behind it."""

    app: Any
    engine: FakeEngine
    server: BeamFirstServer
    port: int
    headers: dict[str, str]
    trusted: ssl.SSLContext | None = None

    @property
    def hub(self) -> LiveHub:
        return self.app.state.live

    @property
    def running(self) -> FakeRunning:
        return self.engine.running

    @property
    def cookie(self) -> dict[str, str]:
        return {"Cookie": self.headers["Cookie"]}

    def watch(self, query: str = "", **options: Any) -> ClientConnection:
        url = f"{'ws' if self.trusted is None else 'wss'}://127.0.0.1:{self.port}/api/v1/live{query}"
        # The library waits ten seconds for the goodbye of a server whose messages the client has not all read.
        preset = {"close_timeout": 0.1, "max_queue": None, "ssl": self.trusted}
        preset |= {"open_timeout": PATIENCE_S, "ping_interval": None}
        return connect(url, additional_headers=self.cookie, **{**preset, **options})

    def http(self) -> httpx2.Client:
        url = f"{'http' if self.trusted is None else 'https'}://127.0.0.1:{self.port}"
        return httpx2.Client(base_url=url, headers=self.headers, timeout=PATIENCE_S, verify=self.trusted or True)

    def raw(self, path: str, *, receive_bytes: int = 4096) -> socket.socket:
        """Open a stream and read nothing of it but what is asked for; the system keeps as little as it can."""
        connection = socket.socket()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        connection.settimeout(PATIENCE_S)
        connection.connect(("127.0.0.1", self.port))
        if self.trusted is not None:
            connection = self.trusted.wrap_socket(connection, server_hostname="127.0.0.1")
        upgrade = (
            ""
            if path.endswith("events") or "events?" in path
            else (
                "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
            )
        )
        head = (
            f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nCookie: {self.headers['Cookie']}\r\n{upgrade}\r\n"
        )
        connection.sendall(head.encode())
        return connection

    def begin_session(self) -> str:
        """Create and start a session; returns its id."""
        with self.http() as client:
            made = client.post(
                "/api/v1/calibrations",
                content=make_calibration().to_json(),
                headers={"Content-Type": "application/json"},
            )
            body = make_session_body(made.json()["id"])
            del body["operator"]
            session_id = client.post("/api/v1/sessions", json=body).json()["id"]
            assert client.post(f"/api/v1/sessions/{session_id}/start", json={}).status_code == 200
        return session_id

    def end_session(self, session_id: str) -> None:
        with self.http() as client:
            assert client.post(f"/api/v1/sessions/{session_id}/stop", json={}).status_code in {200, 409}
        eventually(lambda: self.app.state.services.runner.running_camera() is None)

    def frames(self, count: int, **options: Any) -> None:
        """Let frames come, each once the hub has seen the one before."""
        for _ in range(count):
            record = self.running.frame(**options)
            eventually(lambda index=record.measurement.frame_index: self._has_seen(index))

    def _has_seen(self, index: int) -> bool:
        newest = self.hub.newest
        return newest is not None and newest.index >= index

    def await_clients(self, count: int) -> None:
        """Wait until so many clients are connected."""
        eventually(lambda: sum(self.hub.reading().clients.values()) == count, detail=self.hub.reading)

    def await_closed(self, why: str, count: int) -> None:
        """Wait until so many clients were let go for this reason; a client may see its end before it is counted."""
        eventually(lambda: self.hub.reading().closed.get(why, 0) >= count, detail=self.hub.reading)
        assert self.hub.reading().closed[why] == count

    def make_messages_big(self) -> None:
        """Let every sample from now on take 20 kB."""
        self.running.operator_hold = BIG

    def change(self, gate: GateState) -> None:
        """Let the gate change between two frames."""
        before = self.running.latest
        record = replace(before.record, gate_state=gate)
        self.running.latest = replace(before, record=record)

    def recorded(self, session_id: str, last: int) -> None:
        """Wait until the recorder has written a frame."""
        path = self.app.state.resumption

        def is_there() -> bool:
            return path._tails.page(session_id, last - 1, oldest_ns=0, most=1).rows != []

        eventually(is_there)


@contextlib.contextmanager
def served(folder: Path, *, stall_s: float = 60.0, **settings: Any) -> Iterator[Served]:
    """Serve until the block ends; a client that reads nothing for ``stall_s`` is disconnected."""
    recordings = folder / "recordings"
    recordings.mkdir(parents=True)
    (recordings / "chest.oni").write_bytes(b"not read by the fake engine")
    port = free_port()
    chosen = Settings(
        data_dir=folder / "data",
        recordings_dirs=(recordings,),
        port=port,
        **{"journal_dir": folder / "journals", **settings},
    )
    with patch("service.web.app.STALL_S", stall_s), patch("service.sessions.lifecycle.start.SAMPLE_BATCH_S", 0.02):
        engine = FakeEngine()
        app = create_app(chosen, lambda _settings: engine)
        server = make_server(app, host="127.0.0.1", port=port, certificate=app.state.certificate)
        trusted = ssl.create_default_context(cafile=chosen.tls_cert) if chosen.has_tls else None
        thread = threading.Thread(target=lambda: asyncio.run(server.serve()), name="server of a test")
        thread.start()
        try:
            eventually(lambda: server.started or not thread.is_alive())
            opened = open_login(app.state.access.store, "A. Therapist")
            origin = f"{'https' if chosen.has_tls else 'http'}://127.0.0.1:{port}"
            headers = headers_of(opened, origin, CookieScope(is_secure=chosen.is_secure, room=chosen.room))
            yield Served(app=app, engine=engine, server=server, port=port, headers=headers, trusted=trusted)
        finally:
            server.should_exit = True
            thread.join(PATIENCE_S)
            assert not thread.is_alive()


def messages(connection: ClientConnection, *, within_s: float = PATIENCE_S) -> Iterator[dict[str, Any]]:
    """Read messages; fails where none comes in time."""
    while True:
        yield json.loads(connection.recv(timeout=within_s))


def next_of(connection: ClientConnection, kind: str) -> dict[str, Any]:
    return next(one for one in messages(connection) if one["type"] == kind)


def read_until(connection: socket.socket, raw: bytearray, frame_index: int) -> list[dict[str, Any]]:
    """Read into ``raw`` until the sample of this frame is there; return all messages so far."""
    while True:
        found = socket_texts(bytes(raw))
        if any(one["type"] == "sample" and one["frame_index"] == frame_index for one in found):
            return found
        piece = connection.recv(65536)
        assert piece, "the connection ended"
        raw += piece


def socket_texts(raw: bytes) -> list[dict]:
    """Take apart the text frames that a server sent behind its handshake; leave out one that is not all here."""
    rest, found = raw.partition(b"\r\n\r\n")[2], []
    while len(rest) >= LONGEST_FRAME_HEAD:
        size, start = rest[1] & 0x7F, 2
        if size == 126:
            (size,), start = struct.unpack(">H", rest[2:4]), 4
        elif size == 127:
            (size,), start = struct.unpack(">Q", rest[2:10]), 10
        payload = rest[start : start + size]
        if rest[0] == 0x81 and len(payload) == size:
            found.append(json.loads(payload))
        rest = rest[start + size :]
    return found
