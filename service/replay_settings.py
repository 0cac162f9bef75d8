"""What a site sets about looking back: whether the frames of a camera are kept."""

from pydantic import Field
from pydantic_settings import BaseSettings


class ReplaySettings(BaseSettings):
    """Raw recordings of sessions on a camera; see docs/replay.md."""

    record_raw: bool = Field(
        default=False, description="Keep every frame of a camera beside its session, so that it can be replayed"
    )
    raw_min_free_mb: float = Field(
        default=2_000.0,
        ge=500.0,
        le=1_000_000.0,
        description="A raw recording ends where the disk has less room left than this",
    )
