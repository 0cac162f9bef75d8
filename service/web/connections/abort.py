"""Aborts a connection and discards its buffers, including the kernel's."""

import contextlib
import socket
import struct
from asyncio import Transport

_NO_LINGER = struct.pack("ii", 1, 0)


def abort(transport: Transport) -> None:
    """Abort a connection and discard unsent data; a plain close would keep sending to a client that does not read."""
    try:
        raw = transport.get_extra_info("socket")
    except AttributeError:
        # asyncio's TLS transport drops its connection when closed a second time, as uvicorn does: nothing can be
        # aborted through it any more, and the TLS shutdown's own timeout ends the connection.
        return
    if raw is not None:
        with contextlib.suppress(OSError):
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
    transport.abort()
