"""Clients that a service has to part from: sockets that read and sockets that do not, a slow download, half a body."""

import base64
import contextlib
import os
import selectors
import socket
import threading
from collections.abc import Iterator, Mapping

LIVE = "/api/v1/live"
EVENTS = "/api/v1/live/events"
WAIT_S = 20.0
LITTLE_BYTES = 2048


class Crowd:
    """Raw connections to one service, kept until the end."""

    def __init__(self, port: int, headers: Mapping[str, str]) -> None:
        self._port = port
        self._headers = dict(headers)
        self._open: list[socket.socket] = []
        self._reading = selectors.DefaultSelector()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._read_on, daemon=True)
        self._thread.start()

    def watch(self, *, reads: bool) -> None:
        """Open the live stream; one that does not read fills up."""
        key = base64.b64encode(os.urandom(16)).decode()
        upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        status = self._ask("GET", LIVE, {**upgrade, "Sec-WebSocket-Key": key}, reads=reads)
        assert status == 101, f"the live stream answered {status}"

    def listen(self) -> None:
        """Open the stream of events, and read it."""
        status = self._ask("GET", EVENTS, {"Accept": "text/event-stream"}, reads=True)
        assert status == 200, f"the stream of events answered {status}"

    def download_slowly(self, path: str) -> None:
        """Begin a download, and read no further."""
        status = self._ask("GET", path, {}, reads=False)
        assert status == 200, f"{path} answered {status}"

    def send_half(self, path: str) -> None:
        """Announce a body and send half of it."""
        connection = self._connect(small=False)
        head = self._head("POST", path, {"Content-Type": "application/json", "Content-Length": "2000"})
        connection.sendall(head + b'{"patient_reference": "')

    def close(self) -> None:
        """Leave."""
        self._is_over.set()
        self._thread.join()
        for connection in self._open:
            connection.close()

    def _ask(self, method: str, path: str, headers: Mapping[str, str], *, reads: bool) -> int:
        connection = self._connect(small=not reads)
        connection.sendall(self._head(method, path, headers))
        first = connection.recv(64)
        if reads:
            connection.setblocking(False)
            self._reading.register(connection, selectors.EVENT_READ)
        return int(first.split(b" ", 2)[1])

    def _connect(self, *, small: bool) -> socket.socket:
        connection = socket.socket()
        connection.settimeout(WAIT_S)
        if small:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, LITTLE_BYTES)
        connection.connect(("127.0.0.1", self._port))
        self._open.append(connection)
        return connection

    def _head(self, method: str, path: str, headers: Mapping[str, str]) -> bytes:
        reported = {"Host": "127.0.0.1", **self._headers, **headers}
        lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in reported.items())]
        return "\r\n".join([*lines, "", ""]).encode()

    def _read_on(self) -> None:
        while not self._is_over.wait(0.02):
            with contextlib.suppress(OSError):
                for key, _ in self._reading.select(0.05) if self._reading.get_map() else ():
                    self._drain(key.fileobj)

    def _drain(self, connection: socket.socket) -> None:
        try:
            gone = connection.recv(1 << 16) == b""
        except BlockingIOError:
            return
        except OSError:
            gone = True
        if gone:
            self._reading.unregister(connection)


@contextlib.contextmanager
def crowd(port: int, headers: Mapping[str, str]) -> Iterator[Crowd]:
    """Make a crowd, and send it home."""
    made = Crowd(port, headers)
    try:
        yield made
    finally:
        made.close()
