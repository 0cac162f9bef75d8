"""A real web server with real sockets on a fake engine: the frames are the test's."""

import asyncio
import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import httpx2
from websockets.sync.client import ClientConnection, connect

from engine.permits import GateState
from service.app import create_app
from service.server import make_server
from service.settings import Settings
from service.stream.hub import LiveHub
from tests.service.conftest import eventually, make_calibration, make_session_body
from tests.service.fakes import FakeEngine, FakeRunning
from tests.service.people import headers_of, open_login
from tests.service.processes import free_port


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Served:
    """The service as a client sees it, and the engine behind it."""

    app: Any
    engine: FakeEngine
    port: int
    headers: dict[str, str]

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
        url = f"ws://127.0.0.1:{self.port}/api/v1/live{query}"
        # Nobody waits for the goodbye of a client that has not read all; the library would, for ten seconds.
        return connect(url, additional_headers=self.cookie, **{"close_timeout": 0.1, "max_queue": None, **options})

    def http(self) -> httpx2.Client:
        return httpx2.Client(base_url=f"http://127.0.0.1:{self.port}", headers=self.headers, timeout=10.0)

    def raw(self, path: str, *, receive_bytes: int = 4096) -> socket.socket:
        """Open a stream and read nothing of it but what is asked for; the system keeps as little as it can."""
        connection = socket.socket()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        connection.settimeout(10.0)
        connection.connect(("127.0.0.1", self.port))
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
        eventually(lambda: self.app.state.services.runner.running_camera() is None, within_s=10.0)

    def frames(self, count: int, **options: Any) -> None:
        """Let frames come, each once the hub has seen the one before."""
        for _ in range(count):
            record = self.running.frame(**options)
            eventually(lambda index=record.measurement.frame_index: self._has_seen(index))

    def _has_seen(self, index: int) -> bool:
        newest = self.hub.newest
        return newest is not None and newest.index >= index

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
def served(folder: Path, **settings: Any) -> Iterator[Served]:
    """Serve until the block ends."""
    recordings = folder / "recordings"
    recordings.mkdir(parents=True)
    (recordings / "chest.oni").write_bytes(b"not read by the fake engine")
    port = free_port()
    chosen = Settings(
        data_dir=folder / "data",
        recordings_dirs=(recordings,),
        port=port,
        **{"sample_batch_ms": 20.0, "journal_dir": folder / "journals", **settings},
    )
    engine = FakeEngine()
    app = create_app(chosen, lambda _settings: engine)
    server = make_server(app, host="127.0.0.1", port=port)
    thread = threading.Thread(target=lambda: asyncio.run(server.serve()), name="server of a test")
    thread.start()
    try:
        eventually(lambda: server.started or not thread.is_alive(), within_s=20.0)
        opened = open_login(app.state.access.store, "A. Therapist")
        yield Served(app=app, engine=engine, port=port, headers=headers_of(opened, f"http://127.0.0.1:{port}"))
    finally:
        server.should_exit = True
        thread.join(20.0)
        assert not thread.is_alive()


def messages(connection: ClientConnection, *, within_s: float = 5.0) -> Iterator[dict[str, Any]]:
    """Read messages; fails where none comes in time."""
    while True:
        yield json.loads(connection.recv(timeout=within_s))


def next_of(connection: ClientConnection, kind: str) -> dict[str, Any]:
    return next(one for one in messages(connection) if one["type"] == kind)
