"""What a site sets about the live stream."""

from pydantic import Field
from pydantic_settings import BaseSettings


class StreamSettings(BaseSettings):
    """Who may watch, and what becomes of who does not keep up; see docs/stream.md."""

    max_live_clients: int = Field(
        default=256, ge=1, le=1024, description="Sockets and event streams together that may watch at a time"
    )
    live_stall_s: float = Field(
        default=5.0, ge=0.5, le=60.0, description="A client that takes nothing for so long is cut off"
    )
    live_resume_s: float = Field(
        default=600.0,
        ge=0.0,
        le=600.0,
        description="Most that is sent again to a client that comes back",
    )
