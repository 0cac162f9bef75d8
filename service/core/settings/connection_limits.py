"""Limits of connections: times, sizes, numbers."""

from dataclasses import dataclass, fields

CONNECTION_BOUNDS = {
    "header_s": (1.0, 60.0),
    "body_s": (1.0, 600.0),
    "keep_alive_s": (1.0, 300.0),
    "write_s": (1.0, 600.0),
    "handshake_s": (1.0, 60.0),
    "max_connections": (64, 16_384),
    "max_connections_per_address": (16, 16_384),
    "max_header_bytes": (4_096, 65_536),
    "max_headers": (16, 256),
    "max_url_bytes": (1_024, 16_384),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLimits:
    """Limits of every connection.

    Attributes
    ----------
    header_s
        From a connection's begin, or from a further request's first byte, to the end of its headers.
    body_s
        From the end of the headers to the end of the body.
    keep_alive_s
        Between an answer and the next request.
    write_s
        For which a client may leave what was sent to it unread.
    handshake_s
        For TLS.
    max_connections, max_connections_per_address
        Beyond them the connection goes that has been waited for longest: for a request, the rest of one, or for its
        client to read; unauthenticated ones first. One with a request in progress is never closed for another.
    """

    header_s: float = 10.0
    body_s: float = 30.0
    keep_alive_s: float = 5.0
    write_s: float = 20.0
    handshake_s: float = 10.0
    max_connections: int = 2048
    max_connections_per_address: int = 512
    max_header_bytes: int = 16_384
    max_headers: int = 64
    max_url_bytes: int = 4_096


LIMIT_NAMES = tuple(one.name for one in fields(ConnectionLimits))
