"""Settings of disk use: retention and quota."""

from pathlib import Path
from typing import TYPE_CHECKING, Self

from pydantic import Field, SecretStr, model_validator
from pydantic_settings import BaseSettings

from service.core.settings.database_place import place_of

if TYPE_CHECKING:  # the engine's process does without SQLAlchemy
    from sqlalchemy import URL


# Which database a site uses: the part of the settings that begins with ``database_``.


class DatabaseSettings(BaseSettings):
    """The settings of the database; a part of :class:`service.core.settings.settings.Settings`."""

    data_dir: Path = Path("data")
    database_url: SecretStr | None = Field(
        default=None,
        min_length=1,
        max_length=2048,
        description="postgresql://USER@HOST/DATABASE; the SQLite file tidegate.db in the data folder when left out",
    )
    database_password_file: Path | None = Field(
        default=None, description="File that holds the password of database_url, in one line"
    )

    @model_validator(mode="after")
    def _is_a_place(self) -> Self:
        _ = self.database_place
        return self

    @property
    def database_place(self) -> "Path | URL":
        """What :class:`service.storage.database.engine.Database` opens; the password is in it, for the driver alone."""
        return place_of(self.database_url, self.database_password_file, self.data_dir)


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
