"""Settings of raw recordings."""

from pydantic import Field
from pydantic_settings import BaseSettings


class ReplaySettings(BaseSettings):
    """Raw recordings of sessions on a camera; see docs/3-operate/replay.md."""

    record_raw: bool = Field(
        default=False, description="Record every frame of a live camera, so that the session can be replayed"
    )
    raw_min_free_mb: float = Field(
        default=2_000.0,
        ge=500.0,
        le=1_000_000.0,
        description="A raw recording ends when less disk space than this is free",
    )
