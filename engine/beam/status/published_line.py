"""A beam line whose commands and readings are published; publishing never affects the line.

Sends a line's status to one subscriber, from a thread of its own; no decision waits for it or depends on it.

Every change is sent, and the status once a second. Publishing appends to a bounded queue and wakes the thread. When the
queue is full the oldest change is dropped; drops and failures are counted.

Status of a beam line for subscribers, as a value and as the JSON of docs/3-operate/beam.md.
"""

import contextlib
import enum
import http.client
import json
import queue
import socket
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol
from urllib.parse import urlsplit

from engine.beam.line import BeamLine, TroubleListener, ignore_trouble
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease

SCHEMA = "tidegate.beam/1"
GOOD_FOR_NS = 250 * NS_PER_MS
"""A reading of on becomes unknown after this time without a newer one: no lease and no settling lasts longer."""
HEARTBEAT_NS = NS_PER_S
CLOSE_S = 1.0
USER_AGENT = "tidegate"


class BeamState(enum.StrEnum):
    """State of the beam line as last read back."""

    ON = "on"
    OFF = "off"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class LineStatus:
    """Command and read-back of the line at ``at_ns``, host monotonic time [ns].

    ``reason`` is why it was last held, None while it is permitted.
    """

    beam: BeamState
    is_permitted: bool
    reason: HoldReason | None
    trouble: str | None
    at_ns: int

    def aged(self, now_ns: int) -> "LineStatus":
        """Return the status as of ``now_ns``: a reading of on that is too old becomes unknown."""
        is_old = self.beam is BeamState.ON and now_ns - self.at_ns > GOOD_FOR_NS
        return replace(self, beam=BeamState.UNKNOWN) if is_old else self

    def is_same(self, other: "LineStatus") -> bool:
        """Whether everything but the time is equal."""
        return replace(self, at_ns=other.at_ns) == other

    def document(self, *, kind: str, sequence: int, sent_at: str, now_ns: int) -> dict[str, object]:
        """Return the JSON document to send; ``sent_at`` is RFC 3339 UTC, ``kind`` change or heartbeat."""
        return {
            "schema": SCHEMA,
            "kind": kind,
            "sequence": sequence,
            "sent_at": sent_at,
            "age_ms": round((now_ns - self.at_ns) / NS_PER_MS, 1),
            "beam": str(self.beam),
            "permitted": self.is_permitted,
            "reason": None if self.reason is None else str(self.reason),
            "trouble": self.trouble,
        }


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


class PublishedBeamLine:
    """`BeamLine` around another one; it publishes after the wrapped line has acted."""

    def __init__(self, line: BeamLine, publishers: Sequence[StatusPublisher], clock: Clock) -> None:
        self.on_trouble: TroubleListener = ignore_trouble
        self._line, self._publishers, self._clock = line, tuple(publishers), clock
        self._beam = BeamState.UNKNOWN
        self._reason: HoldReason | None = HoldReason.DISARMED
        self._trouble: str | None = None
        line.on_trouble = self._note_trouble

    def open(self) -> None:
        """Connect and start publishing; where either fails, nothing is left open."""
        self._line.open()
        try:
            for publisher in self._publishers:
                publisher.start()
        except BaseException:
            self.close()
            raise
        self._publish(beam=BeamState.OFF)

    def rearm(self) -> None:
        """Accept permits again."""
        self._line.rearm()
        self._trouble = None

    def permit(self, lease: Lease) -> None:
        """Permit; published once it is read back by :meth:`is_on`."""
        self._line.permit(lease)
        self._reason = None

    def hold(self, reason: HoldReason) -> None:
        """Hold, then publish."""
        self._line.hold(reason)
        self._reason = reason
        self._publish()

    def is_on(self) -> bool:
        """Read back and publish the reading."""
        try:
            is_on = self._line.is_on()
        except BeamLineError as error:
            self._trouble = str(error)
            self._publish(beam=BeamState.UNKNOWN)
            raise
        self._publish(beam=BeamState.ON if is_on else BeamState.OFF)
        return is_on

    @property
    def is_settling(self) -> bool:
        """Whether the line settles."""
        return self._line.is_settling

    def close(self) -> None:
        """Hold and disconnect, then stop publishing."""
        self.hold(HoldReason.ENGINE_STOPPED)
        try:
            self._line.close()
        finally:
            for publisher in self._publishers:
                publisher.stop()

    def _note_trouble(self, reason: HoldReason, detail: str) -> None:
        self._reason, self._trouble = reason, detail
        self._publish(beam=BeamState.UNKNOWN)
        self.on_trouble(reason, detail)

    def _publish(self, *, beam: BeamState | None = None) -> None:
        self._beam = self._beam if beam is None else beam
        status = LineStatus(
            beam=self._beam,
            is_permitted=self._reason is None,
            reason=self._reason,
            trouble=self._trouble,
            at_ns=self._clock.now_ns(),
        )
        for publisher in self._publishers:
            publisher.publish(status)
