"""Dashboards that only watch.

A program of its own with many light clients, ``python -m verification.load.watchers``.

Spoken to as ``verification.load.program_protocol`` says. It tells what each client saw, and how late its own loop
was, which is part
of every age that it tells.
"""

import asyncio
import base64
import secrets
import socket
import struct
import time
from bisect import bisect_right
from collections import Counter
from dataclasses import dataclass, field

from verification.load.message_heads import Head, read_head
from verification.load.program_protocol import processor_s, say, trusted_by, work_as_asked

OPENED_PER_S = 100
TICK_S = 0.01
TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
EDGES_MS = (5, 10, 20, 33, 50, 67, 100, 150, 200, 300, 500, 1000, 2000, 5000)
"""Ages are counted in bins, so that an hour of them is no more than a minute."""


@dataclass(slots=True)
class Seen:
    """What one client saw since it was asked to count."""

    samples: int = 0
    other: Counter[str] = field(default_factory=Counter)
    skipped_reported: int = 0
    gaps: int = 0
    backwards: int = 0
    lost_to_gaps: int = 0
    worst_age_ms: float = 0.0
    worst_lag_frames: int = 0
    behind_two: int = 0
    longest_silence_ms: float = 0.0
    ages: list[int] = field(default_factory=lambda: [0] * (len(EDGES_MS) + 1))
    closed: str | None = None


class Newest:
    """The newest frame that any client of this program has received of, and the last message read."""

    def __init__(self) -> None:
        self.frame_index = -1
        self._payload = b""
        self._head = Head(kind="none")

    def head_of(self, payload: bytes) -> Head:
        """Read a message's head; the same bytes are read once."""
        if payload != self._payload:
            self._payload, self._head = payload, read_head(payload)
            if self._head.frame_index is not None:
                self.frame_index = max(self.frame_index, self._head.frame_index)
        return self._head


class Watcher(asyncio.Protocol):
    """One client of the stream, over a WebSocket or as server-sent events; ``is_stalled`` never reads."""

    def __init__(self, asked: dict[str, object], newest: Newest, *, is_events: bool, is_stalled: bool) -> None:
        self._asked, self._newest, self._is_events, self._is_stalled = asked, newest, is_events, is_stalled
        self.ready: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._buffer = b""
        self._transport: asyncio.Transport | None = None
        self._sequence: int | None = None
        self._received_s = time.monotonic()
        self.seen = Seen()

    def begin(self) -> None:
        """Forget what was seen before."""
        closed = self.seen.closed
        self.seen, self._received_s = Seen(closed=closed), time.monotonic()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        path = "/api/v1/live/events" if self._is_events else "/api/v1/live"
        query = f"?{self._asked['query']}" if self._asked["query"] else ""
        lines = [f"GET {path}{query} HTTP/1.1", f"Host: 127.0.0.1:{self._asked['port']}"]
        lines += [f"Authorization: {self._asked['authorization']}"]
        if self._is_events:
            lines += ["Accept: text/event-stream"]
        else:
            key = base64.b64encode(secrets.token_bytes(16)).decode()
            lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
            lines += [f"Sec-WebSocket-Key: {key}"]
        transport.write("\r\n".join([*lines, "", ""]).encode())

    def data_received(self, data: bytes) -> None:
        self._buffer = self._buffer + data if self._buffer else data
        if not self.ready.done():
            head, end, rest = self._buffer.partition(b"\r\n\r\n")
            if not end:
                return
            self._buffer = rest
            status = head.split(b" ", 2)[1]
            if status not in {b"101", b"200"}:
                self.seen.closed = f"refused with {status.decode()}"
            elif self._is_stalled and self._transport is not None:
                self._transport.pause_reading()
            self.ready.set_result(None)
        if self._is_events:
            self._take_events()
        else:
            self._take_frames()

    def connection_lost(self, _error: Exception | None) -> None:
        self.seen.closed = self.seen.closed or "lost"
        if not self.ready.done():
            self.ready.set_result(None)

    def _take_frames(self) -> None:
        buffer, at = self._buffer, 0
        while len(buffer) - at >= 2:
            opcode, length, start = buffer[at] & 0x0F, buffer[at + 1] & 0x7F, at + 2
            if length >= 126:
                form, size = (">H", 2) if length == 126 else (">Q", 8)
                if len(buffer) < start + size:
                    break
                (length,) = struct.unpack_from(form, buffer, start)
                start += size
            if len(buffer) < start + length:
                break
            self._take_frame(opcode, buffer[start : start + length])
            at = start + length
        self._buffer = buffer[at:]

    def _take_frame(self, opcode: int, payload: bytes) -> None:
        if opcode in {TEXT, BINARY}:
            self._take(payload)
        elif opcode == PING and self._transport is not None:
            # A mask of zeros is a mask: what it masks stays as it is.
            self._transport.write(bytes((0x80 | PONG, 0x80 | len(payload))) + bytes(4) + payload)
        elif opcode == CLOSE:
            self.seen.closed = (
                f"closed with {int.from_bytes(payload[:2], 'big')} {payload[2:].decode(errors='replace')}"
            )

    def _take_events(self) -> None:
        *whole, self._buffer = self._buffer.split(b"\n\n")
        for event in whole:
            at = event.find(b"data: ")
            if at >= 0:
                self._take(event[at + 6 :])

    def _take(self, payload: bytes) -> None:
        head, seen = self._newest.head_of(payload), self.seen
        if head.kind != "sample":
            seen.other[head.kind] += 1
            seen.skipped_reported += head.skipped
            return
        now_s = time.monotonic()
        seen.longest_silence_ms = max(seen.longest_silence_ms, 1e3 * (now_s - self._received_s))
        self._received_s = now_s
        seen.samples += 1
        self._count_sequence(head.sequence)
        lag = 0 if head.frame_index is None else self._newest.frame_index - head.frame_index
        seen.worst_lag_frames = max(seen.worst_lag_frames, lag)
        seen.behind_two += lag > 2
        age_ms = head.age_now_ms
        if age_ms is not None:
            seen.worst_age_ms = max(seen.worst_age_ms, age_ms)
            seen.ages[bisect_right(EDGES_MS, age_ms)] += 1

    def _count_sequence(self, sequence: int | None) -> None:
        before, self._sequence = self._sequence, sequence
        if before is None or sequence is None or sequence == before + 1:
            return
        if sequence <= before:
            self.seen.backwards += 1
        else:
            self.seen.gaps += 1
            self.seen.lost_to_gaps += sequence - before - 1


async def _run(asked: dict[str, object], lines: asyncio.StreamReader) -> dict[str, object]:
    loop, newest, watchers = asyncio.get_running_loop(), Newest(), []
    trusted = trusted_by(asked)
    clients, events, stalled = (int(str(asked[name])) for name in ("clients", "events", "stalled"))
    for number in range(clients):
        place = socket.socket()
        if number < stalled:
            place.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        place.setblocking(False)
        await loop.sock_connect(place, ("127.0.0.1", int(str(asked["port"]))))
        is_events = number >= clients - events
        _, watcher = await loop.create_connection(
            lambda: Watcher(asked, newest, is_events=is_events, is_stalled=number < stalled),  # noqa: B023 - called now
            sock=place,
            ssl=trusted,
            server_hostname=None if trusted is None else "127.0.0.1",
        )
        watchers.append(watcher)
        await asyncio.sleep(1.0 / OPENED_PER_S)
    await asyncio.wait_for(asyncio.gather(*(watcher.ready for watcher in watchers)), 60.0)
    say("ready")
    lateness: list[float] = []
    ticking = asyncio.create_task(_tick(lateness))
    await lines.readline()
    for watcher in watchers:
        watcher.begin()
    lateness.clear()
    before_s = processor_s()
    await lines.readline()
    ticking.cancel()
    return {
        "clients": [_reported(watcher, number < stalled) for number, watcher in enumerate(watchers)],
        "edges_ms": EDGES_MS,
        "processor_s": processor_s() - before_s,
        "late_ms": sorted(lateness)[-max(1, len(lateness) // 1000) :][0] if lateness else 0.0,
        "latest_ms": max(lateness, default=0.0),
    }


def _reported(watcher: Watcher, is_stalled: bool) -> dict[str, object]:
    seen = watcher.seen
    return {name: getattr(seen, name) for name in Seen.__slots__} | {"is_stalled": is_stalled}


async def _tick(lateness: list[float]) -> None:
    """Note how late this program's own loop comes round [ms]."""
    while True:
        due_s = time.monotonic() + TICK_S
        await asyncio.sleep(TICK_S)
        lateness.append(1e3 * (time.monotonic() - due_s))


if __name__ == "__main__":
    work_as_asked(_run)
