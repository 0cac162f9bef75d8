"""Sends a line's status to one subscriber, from a thread of its own; no decision waits for it or depends on it.

Every change is sent, and the status once a second. Publishing appends to a bounded queue and wakes the thread. When the
queue is full the oldest change is dropped; drops and failures are counted.
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

from engine.beam.status.message import GOOD_FOR_NS, BeamState, LineStatus
from engine.core.clock import NS_PER_S, Clock

HEARTBEAT_NS = NS_PER_S
CLOSE_S = 1.0
USER_AGENT = "tidegate"


class Sender(Protocol):
    """Transport of messages; used by one thread, may block for a bounded time."""

    @property
    def queue_size(self) -> int:
        """Greatest number of changes that wait to be sent."""

    def send(self, message: bytes) -> None:
        """Send one message; raise OSError or HTTPException where it fails."""

    def close(self) -> None:
        """Close; safe to call twice."""


class UdpSender:
    """Sends each message as one UDP datagram."""

    queue_size = 64

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._socket: socket.socket | None = None

    def send(self, message: bytes) -> None:
        """Send; after a failure the host name is resolved again."""
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
    """Sends the newest message as one POST; ``url`` is http or https, and redirections are failures."""

    queue_size = 1

    def __init__(self, url: str, *, timeout_s: float) -> None:
        parts = urlsplit(url)
        self._kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        self._host, self._port = parts.hostname or "", parts.port
        self._path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        self._timeout_s = timeout_s

    def send(self, message: bytes) -> None:
        """Send one POST; raise OSError unless the answer is 2xx."""
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


class StatusPublisher:
    """Sends the status of one line to one subscriber.

    Attributes
    ----------
    sent, failures, dropped
        Counts of messages; any thread may read them.
    last_error
        Text of the newest failure.
    """

    def __init__(self, sender: Sender, clock: Clock, *, utc_now: Callable[[], str]) -> None:
        self._sender, self._clock, self._utc_now = sender, clock, utc_now
        self._changes: deque[LineStatus] = deque(maxlen=sender.queue_size)
        self._newest: LineStatus | None = None
        self._last_sent: LineStatus | None = None
        self._sequence = 0
        self._wakeups: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._stop_requested = threading.Event()
        self._thread: threading.Thread | None = None
        self._next_beat_ns = 0
        self.sent = self.failures = self.dropped = 0
        self.last_error: str | None = None

    def start(self) -> None:
        """Start sending."""
        self._stop_requested.clear()
        self._next_beat_ns = self._clock.now_ns()
        self._thread = threading.Thread(target=self._work, name="tidegate-beam-status", daemon=True)
        self._thread.start()

    def publish(self, status: LineStatus) -> None:
        """Queue a status, from any thread; never blocks, never raises."""
        newest, self._newest = self._newest, status
        if newest is not None and newest.is_same(status):
            return
        if len(self._changes) == self._changes.maxlen:
            self.dropped += 1
        self._changes.append(status)
        self._wakeups.put(None)

    def stop(self) -> None:
        """Send the queued changes as far as possible, and stop the thread; waits for at most 1 s."""
        thread, self._thread = self._thread, None
        self._stop_requested.set()
        self._wakeups.put(None)
        if thread is not None:
            thread.join(CLOSE_S)

    def send_pending(self) -> None:
        """Send the queued changes, and the heartbeat when it is due."""
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

    def _send(self, status: LineStatus, kind: str) -> None:
        now_ns = self._clock.now_ns()
        self._sequence += 1
        self._last_sent = status
        self._next_beat_ns = now_ns + HEARTBEAT_NS
        document = status.document(kind=kind, sequence=self._sequence, sent_at=self._utc_now(), now_ns=now_ns)
        try:
            self._sender.send(json.dumps(document).encode())
            self.sent += 1
        except Exception as error:  # noqa: BLE001 - a subscriber that cannot be reached is counted only
            self.failures += 1
            self.last_error = str(error) or type(error).__name__

    def _wait_ns(self) -> int:
        """Time until something must be sent without a new change [ns]."""
        wait_ns = self._next_beat_ns - self._clock.now_ns()
        newest = self._newest
        if newest is not None and newest.beam is BeamState.ON:
            wait_ns = min(wait_ns, GOOD_FOR_NS)
        return max(wait_ns, 1)

    def _work(self) -> None:
        while not self._stop_requested.is_set():
            self.send_pending()
            with contextlib.suppress(queue.Empty):
                self._wakeups.get(timeout=self._wait_ns() / NS_PER_S)
        self.send_pending()
        self._sender.close()
