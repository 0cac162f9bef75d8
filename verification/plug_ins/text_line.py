"""The device of the example beam line: a contact that opens when no line of text has come for half a second."""

import contextlib
import socketserver
import threading
import time
from collections.abc import Iterator

DROP_S = 0.5


class TextLine:
    """The contact and what moved it; ``edges`` are (whether it closed, monotonic time [ns])."""

    def __init__(self) -> None:
        self.edges: list[tuple[bool, int]] = []
        self._permitted_s = -DROP_S
        self._lock = threading.Lock()

    @property
    def is_closed(self) -> bool:
        """Whether the beam may be on."""
        return bool(self.edges) and self.edges[-1][0]

    def take(self, command: str) -> str:
        """Obey one line; return the answer."""
        self._permitted_s = time.monotonic() if command == "on" else -DROP_S
        return "closed" if self.look() else "open"

    def look(self) -> bool:
        """Open the contact where nothing has come for too long; return whether it is closed."""
        with self._lock:
            closes = time.monotonic() - self._permitted_s < DROP_S
            if closes is not self.is_closed:
                self.edges.append((closes, time.monotonic_ns()))
            return closes


@contextlib.contextmanager
def text_line() -> Iterator[tuple[TextLine, int]]:
    """Serve a device on a free port until the block ends."""
    device, stop = TextLine(), threading.Event()

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            for line in self.rfile:
                self.wfile.write(f"{device.take(line.split()[0].decode())}\n".encode())

    def watch() -> None:
        while not stop.wait(0.02):
            device.look()

    socketserver.ThreadingTCPServer.daemon_threads = True
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        threads = [threading.Thread(target=run, daemon=True) for run in (server.serve_forever, watch)]
        for thread in threads:
            thread.start()
        try:
            yield device, int(server.server_address[1])
        finally:
            stop.set()
            server.shutdown()
