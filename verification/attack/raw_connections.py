"""Raw connections: bytes out, bytes in, and whether the other side hung up."""

import base64
import contextlib
import json
import os
import re
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass

PATIENCE_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What came back until the connection ended or no one said more."""

    content: bytes
    is_closed: bool
    seconds: float

    @property
    def statuses(self) -> list[int]:
        """The statuses of all answers."""
        return [int(status) for status in re.findall(rb"HTTP/1\.1 (\d{3}) ", self.content)]

    @property
    def status(self) -> int | None:
        return self.statuses[0] if self.statuses else None

    @property
    def problem(self) -> dict[str, object]:
        return json.loads(self.content.partition(b"\r\n\r\n")[2])

    @property
    def frames(self) -> list[tuple[int, bytes]]:
        """Opcode and payload of the socket's frames behind the handshake."""
        rest, found = self.content.partition(b"\r\n\r\n")[2], []
        while len(rest) >= 2:
            opcode, length, head = rest[0] & 15, rest[1] & 127, 2
            if length == 126:
                length, head = struct.unpack("!H", rest[2:4])[0], 4
            if length == 127:
                length, head = struct.unpack("!Q", rest[2:10])[0], 10
            found.append((opcode, rest[head : head + length]))
            rest = rest[head + length :]
        return found

    @property
    def close_code(self) -> int | None:
        """The code of the socket's last word."""
        closes = [payload for opcode, payload in self.frames if opcode == 8]
        return struct.unpack("!H", closes[0][:2])[0] if closes and len(closes[0]) >= 2 else None


@contextlib.contextmanager
def connection(port: int, source: str = "127.0.0.1", *, room: int | None = None) -> Iterator[socket.socket]:
    """A connection from an address of this machine; ``room`` is how much it takes without being read."""
    with socket.socket() as raw:
        raw.settimeout(PATIENCE_S)
        if room is not None:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)
        raw.bind((source, 0))
        raw.connect(("127.0.0.1", port))
        yield raw


def read_all(raw: socket.socket, within_s: float = PATIENCE_S) -> Reply:
    """Read until the other side hangs up, or for as long as said."""
    begin_s, content, is_closed = time.monotonic(), b"", False
    while not is_closed:
        left_s = begin_s + within_s - time.monotonic()
        if left_s <= 0:
            break
        raw.settimeout(left_s)
        try:
            piece = raw.recv(65536)
        except TimeoutError:
            break
        except ConnectionError:
            piece = b""
        is_closed = not piece
        content += piece
    return Reply(content=content, is_closed=is_closed, seconds=time.monotonic() - begin_s)


def ask(port: int, content: bytes, within_s: float = PATIENCE_S) -> Reply:
    """Send bytes on a connection of their own, and read what comes."""
    with connection(port) as raw:
        with contextlib.suppress(ConnectionError):  # hung up on before all was sent
            raw.sendall(content)
        return read_all(raw, within_s)


def ask_socket(port: int, handshake: bytes, content: bytes) -> Reply:
    """Open a socket, and then send bytes through it."""
    with connection(port) as raw:
        raw.sendall(handshake)
        begun = raw.recv(65536)
        with contextlib.suppress(ConnectionError):
            raw.sendall(content)
        reply = read_all(raw)
    return Reply(content=begun + reply.content, is_closed=reply.is_closed, seconds=reply.seconds)


def upgrade(key: dict[str, str], *more: str, path: str = "/api/v1/live") -> bytes:
    """The handshake of a socket."""
    secret = base64.b64encode(os.urandom(16)).decode()
    lines = [
        f"GET {path} HTTP/1.1",
        "Host: 127.0.0.1",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        f"Sec-WebSocket-Key: {secret}",
        *(f"{name}: {value}" for name, value in key.items()),
        *more,
    ]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def frame(first: int, payload: bytes, *, is_masked: bool = True, length: int | None = None) -> bytes:
    """One frame, with any first byte and any length that it says it has."""
    said = len(payload) if length is None else length
    mask_bit = 0x80 if is_masked else 0
    if said < 126:
        head = struct.pack("!BB", first, mask_bit | said)
    elif said < 65536:
        head = struct.pack("!BBH", first, mask_bit | 126, said)
    else:
        head = struct.pack("!BBQ", first, mask_bit | 127, said)
    return head + (bytes(4) if is_masked else b"") + payload
