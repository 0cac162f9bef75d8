"""What a site sets about the room its sessions take: how long, and how much of, what was measured is kept."""

from pydantic import Field
from pydantic_settings import BaseSettings


class StorageSettings(BaseSettings):
    """Retention, quota, and the room that a new session has to find."""

    retain_samples_days: int = Field(
        default=0, ge=0, le=36_500, description="Samples of sessions that ended longer ago are removed; 0 keeps them"
    )
    retain_raw_days: int = Field(
        default=0, ge=0, le=36_500, description="Raw recordings of such sessions are removed; 0 keeps them"
    )
    data_quota_gb: float = Field(
        default=0.0,
        ge=0.0,
        le=1_000_000.0,
        description="No session begins where the data folder would hold more; 0 is none",
    )
    session_room_min: float = Field(
        default=30.0, ge=1.0, le=1440.0, description="No session begins where a session of this length has no room"
    )
