"""Settings of connections: time limits, sizes and numbers; see docs/3-operate/security.md."""

from typing import Any

from pydantic import Field
from pydantic_settings import BaseSettings

from service.core.settings.connection_limits import CONNECTION_BOUNDS, LIMIT_NAMES, ConnectionLimits


def _limit(name: str, description: str) -> Any:  # noqa: ANN401 - a field of any number's type
    low, high = CONNECTION_BOUNDS[name]
    return Field(default=getattr(ConnectionLimits(), name), ge=low, le=high, description=description)


class ConnectionSettings(BaseSettings):
    """Bounds of every connection."""

    http_header_s: float = _limit("header_s", "A request's headers have to be complete within this time")
    http_body_s: float = _limit("body_s", "A request's body has to be complete within this time behind its headers")
    http_keep_alive_s: float = _limit("keep_alive_s", "A connection without a request is closed after this time")
    http_write_s: float = _limit("write_s", "A client that reads nothing for this time is disconnected")
    http_handshake_s: float = _limit("handshake_s", "The TLS handshake has to be complete within this time")
    http_max_connections: int = _limit(
        "max_connections",
        "Beyond this number the connection whose client was waited for longest is closed; unauthenticated ones first",
    )
    http_max_connections_per_address: int = _limit(
        "max_connections_per_address", "The same per address; trusted proxies are not limited"
    )
    http_max_header_bytes: int = _limit("max_header_bytes", "Size of a request's headers")
    http_max_headers: int = _limit("max_headers", "Number of header lines of a request")
    http_max_url_bytes: int = _limit("max_url_bytes", "Size of path and query")

    @property
    def connection_limits(self) -> ConnectionLimits:
        """The limits as one value, for the web server."""
        return ConnectionLimits(**{name: getattr(self, f"http_{name}") for name in LIMIT_NAMES})
