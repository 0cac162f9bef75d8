"""What a site sets about connections: how slow, how large and how many they may be; see docs/security.md."""

from typing import Any

from pydantic import Field
from pydantic_settings import BaseSettings

from service.doors.limits import DOOR_BOUNDS, LIMIT_NAMES, DoorLimits


def _limit(name: str, description: str) -> Any:  # noqa: ANN401 - a field of any number's type
    low, high = DOOR_BOUNDS[name]
    return Field(default=getattr(DoorLimits(), name), ge=low, le=high, description=description)


class DoorSettings(BaseSettings):
    """Bounds of every connection."""

    http_header_s: float = _limit("header_s", "A request's headers have to be complete within this time")
    http_body_s: float = _limit("body_s", "A request's body has to be complete within this time behind its headers")
    http_keep_alive_s: float = _limit("keep_alive_s", "A connection without a request is closed after this time")
    http_write_s: float = _limit("write_s", "Who reads nothing of what is sent for this time is cut off")
    http_handshake_s: float = _limit("handshake_s", "TLS has to be agreed on within this time")
    http_max_connections: int = _limit(
        "max_connections", "Beyond, the connection goes whose client has been waited for longest; strangers first"
    )
    http_max_connections_per_address: int = _limit(
        "max_connections_per_address", "The same for one sender; proxies that are trusted are not counted"
    )
    http_max_header_bytes: int = _limit("max_header_bytes", "Bytes of a request before its body")
    http_max_headers: int = _limit("max_headers", "Lines of headers of a request")
    http_max_url_bytes: int = _limit("max_url_bytes", "Bytes of path and query")

    @property
    def doors(self) -> DoorLimits:
        """All of them, as the doors know them."""
        return DoorLimits(**{name: getattr(self, f"http_{name}") for name in LIMIT_NAMES})
