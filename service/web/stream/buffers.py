"""Small send buffers for live connections, so that a slow client gets the newest message and no backlog.

Linux would buffer megabytes for a client that does not read. `keep_small` limits the kernel's buffer to about ten
messages and asyncio's to the one that did not fit: the next send waits until that one is sent.

Over TLS asyncio has two buffers: encrypted bytes of the TLS transport wait for the socket's transport, which has a
buffer of its own (64 KiB by default). Both are made small; one message may then wait in each.
"""

import asyncio
import socket
from collections.abc import Mapping
from typing import Any, cast

TRANSPORT = "tidegate.transport"
"""Key of the connection's transport in the state of the ASGI scope."""
SYSTEM_BUFFER_BYTES = 16_384
"""Linux doubles the value and includes its bookkeeping."""
MOST_UNSENT_BYTES = 1
"""High-water mark at which a transport pauses its writer. Not 0: asyncio's TLS transport pauses at ``size >= high``, an
empty buffer included, and checks again only at the next write or read, so that a paused stream stays paused."""


def transport_of(scope: Mapping[str, Any]) -> asyncio.Transport | None:
    """Return the connection's transport; None if another server runs the application."""
    return cast("asyncio.Transport | None", scope.get("state", {}).get(TRANSPORT))


def keep_small(scope: Mapping[str, Any]) -> None:
    """Limit every buffer between the application and this client."""
    transport = transport_of(scope)
    if transport is None:
        return
    transport.set_write_buffer_limits(high=MOST_UNSENT_BYTES)
    below = _below_tls(transport)
    if below is not None:
        below.set_write_buffer_limits(high=MOST_UNSENT_BYTES)
    connection = transport.get_extra_info("socket")
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SYSTEM_BUFFER_BYTES)


def abort(scope: Mapping[str, Any]) -> None:
    """Abort the connection and discard unsent data."""
    transport = transport_of(scope)
    if transport is not None:
        transport.abort()


def _below_tls(transport: asyncio.Transport) -> asyncio.Transport | None:
    """Return the socket's transport below a TLS transport (an asyncio internal); None without TLS."""
    protocol = getattr(transport, "_ssl_protocol", None)
    return cast("asyncio.Transport | None", getattr(protocol, "_transport", None))
