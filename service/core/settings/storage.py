"""Settings of disk use: retention and quota."""

from pydantic import Field
from pydantic_settings import BaseSettings


class StorageSettings(BaseSettings):
    """Retention, quota, and free space for a new session."""

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
        description="A session is refused if the data folder would exceed this size; 0 is no quota",
    )
    session_room_min: float = Field(
        default=30.0,
        ge=1.0,
        le=1440.0,
        description="A session is refused if the free space does not suffice for a session of this length",
    )
