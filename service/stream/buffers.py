"""The buffers between a message sent and a message on its way, made small: what waits in them grows old unseen.

A socket on Linux takes megabytes that nobody reads. So the system may keep some ten messages for a live client, and
the server none beyond the one that did not fit.
"""

import asyncio
import socket
from collections.abc import Mapping
from typing import Any, cast

TRANSPORT = "tidegate.transport"
"""Where the server leaves a connection's transport in the state of the ASGI scope."""
SYSTEM_BUFFER_BYTES = 16_384
"""Linux makes it twice that, and counts its own bookkeeping in."""


def transport_of(scope: Mapping[str, Any]) -> asyncio.Transport | None:
    """Find the connection's transport; None where another server runs the application."""
    return cast("asyncio.Transport | None", scope.get("state", {}).get(TRANSPORT))


def keep_small(scope: Mapping[str, Any]) -> None:
    """Let as little as can be wait between us and this client."""
    transport = transport_of(scope)
    if transport is None:
        return
    transport.set_write_buffer_limits(high=0)
    connection = transport.get_extra_info("socket")
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SYSTEM_BUFFER_BYTES)


def cut_off(scope: Mapping[str, Any]) -> None:
    """End the connection without waiting for what is unread."""
    transport = transport_of(scope)
    if transport is not None:
        transport.abort()
