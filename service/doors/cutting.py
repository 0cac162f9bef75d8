"""A connection ended at once: nothing of it stays, neither here nor in the system's buffers."""

import contextlib
import socket
import struct
from asyncio import Transport

_AT_ONCE = struct.pack("ii", 1, 0)


def cut(transport: Transport) -> None:
    """Drop a connection with what was not sent; a plain close would go on trying to bring it to somebody who sleeps."""
    raw = transport.get_extra_info("socket")
    if raw is not None:
        with contextlib.suppress(OSError):
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
    transport.abort()
