"""Settings of the live stream."""

from pydantic import Field
from pydantic_settings import BaseSettings


class StreamSettings(BaseSettings):
    """Limits of the live stream's clients; see docs/4-integrate/stream.md."""

    max_live_clients: int = Field(
        default=256, ge=1, le=1024, description="Maximum number of clients, WebSockets and event streams together"
    )
    live_stall_s: float = Field(
        default=5.0, ge=0.5, le=60.0, description="A client that reads nothing for this time is disconnected"
    )
    live_resume_s: float = Field(
        default=600.0,
        ge=0.0,
        le=600.0,
        description="Longest part of the record that is resent to a client that reconnects",
    )
