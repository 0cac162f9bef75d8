"""Tells others what a line does, from a thread of its own; it decides nothing, and nobody waits for it.

Each change is sent, and once a second what is known. Who tells leaves the news and rings; what finds no room pushes the
oldest out and is counted, as is what could not be sent.
"""

import contextlib
import http.client
import json
import queue
import socket
import threading
from collections import deque
from collections.abc import Callable
from typing import Protocol
from urllib.parse import urlsplit

from engine.beam.news import GOOD_FOR_NS, BeamState, LineNews
from engine.clock import NS_PER_S, Clock

HEARTBEAT_NS = NS_PER_S
CLOSE_S = 1.0
USER_AGENT = "tidegate"


class Sender(Protocol):
    """A way out for messages; used by one thread, may block for a bounded time."""

    @property
    def room(self) -> int:
        """How many changes may wait."""

    def send(self, message: bytes) -> None:
        """Send one message; raise OSError or HTTPException where it fails."""

    def close(self) -> None:
        """Close; safe to call twice."""


class UdpSender:
    """One datagram a message."""

    room = 64

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._socket: socket.socket | None = None

    def send(self, message: bytes) -> None:
        """Send; the name is looked up anew after a failure."""
        try:
            if self._socket is None:
                family, kind, protocol, _, address = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)[
                    0
                ]
                self._socket = socket.socket(family, kind, protocol)
                self._socket.connect(address)
            self._socket.send(message)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class HttpSender:
    """One POST a message, the newest only; ``url`` is http or https, and redirections are failures."""

    room = 1

    def __init__(self, url: str, *, timeout_s: float) -> None:
        parts = urlsplit(url)
        self._kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        self._host, self._port = parts.hostname or "", parts.port
        self._path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        self._timeout_s = timeout_s

    def send(self, message: bytes) -> None:
        """Post; raise OSError unless the answer is 2xx."""
        connection = self._kind(self._host, self._port, timeout=self._timeout_s)
        try:
            headers = {"Content-Type": "application/json", "User-Agent": USER_AGENT}
            connection.request("POST", self._path, body=message, headers=headers)
            status = connection.getresponse().status
        finally:
            connection.close()
        if not 200 <= status < 300:
            msg = f"answered {status}"
            raise OSError(msg)

    def close(self) -> None:
        """Nothing stays open between messages."""


class Announcer:
    """Sends the news of one line to one receiver.

    Attributes
    ----------
    sent, failures, dropped
        Counts of messages; read by anybody.
    last_error
        Why the newest failure failed.
    """

    def __init__(self, sender: Sender, clock: Clock, *, utc_now: Callable[[], str]) -> None:
        self._sender, self._clock, self._utc_now = sender, clock, utc_now
        self._changes: deque[LineNews] = deque(maxlen=sender.room)
        self._newest: LineNews | None = None
        self._last_sent: LineNews | None = None
        self._sequence = 0
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._stop_requested = threading.Event()
        self._thread: threading.Thread | None = None
        self._next_beat_ns = 0
        self.sent = self.failures = self.dropped = 0
        self.last_error: str | None = None

    def start(self) -> None:
        """Start sending."""
        self._stop_requested.clear()
        self._next_beat_ns = self._clock.now_ns()
        self._thread = threading.Thread(target=self._work, name="tidegate-beam-news", daemon=True)
        self._thread.start()

    def tell(self, news: LineNews) -> None:
        """Take news, from any thread; never blocks, never raises."""
        newest, self._newest = self._newest, news
        if newest is not None and newest.is_same(news):
            return
        if len(self._changes) == self._changes.maxlen:
            self.dropped += 1
        self._changes.append(news)
        self._bell.put(None)

    def stop(self) -> None:
        """Send what waits, as far as it can be sent at once, and end."""
        thread, self._thread = self._thread, None
        self._stop_requested.set()
        self._bell.put(None)
        if thread is not None:
            thread.join(CLOSE_S)

    def announce_once(self) -> None:
        """Send the changes that wait, and the heartbeat where it is due."""
        with contextlib.suppress(IndexError):
            while True:
                self._send(self._changes.popleft(), "change")
        now_ns = self._clock.now_ns()
        newest = self._newest
        if newest is None:
            return
        known = newest.aged(now_ns)
        if self._last_sent is None or not known.is_same(self._last_sent):
            self._send(known, "change")
        elif now_ns >= self._next_beat_ns:
            self._send(known, "heartbeat")

    def _send(self, news: LineNews, kind: str) -> None:
        now_ns = self._clock.now_ns()
        self._sequence += 1
        self._last_sent = news
        self._next_beat_ns = now_ns + HEARTBEAT_NS
        document = news.document(kind=kind, sequence=self._sequence, sent_at=self._utc_now(), now_ns=now_ns)
        try:
            self._sender.send(json.dumps(document).encode())
            self.sent += 1
        except Exception as error:  # noqa: BLE001 - whoever does not listen is counted, and no more
            self.failures += 1
            self.last_error = str(error) or type(error).__name__

    def _wait_ns(self) -> int:
        """How long nothing has to be sent unless somebody rings."""
        wait_ns = self._next_beat_ns - self._clock.now_ns()
        newest = self._newest
        if newest is not None and newest.beam is BeamState.ON:
            wait_ns = min(wait_ns, GOOD_FOR_NS)
        return max(wait_ns, 1)

    def _work(self) -> None:
        while not self._stop_requested.is_set():
            self.announce_once()
            with contextlib.suppress(queue.Empty):
                self._bell.get(timeout=self._wait_ns() / NS_PER_S)
        self.announce_once()
        self._sender.close()
