"""A data folder with an SQLite file that has the newest tables."""

import shutil
from pathlib import Path

from service.core.settings.settings import Settings


def with_tables(settings: Settings, migrated_file: Path) -> Settings:
    """Let a service find the newest tables; on PostgreSQL they are there anyway. Others try a first start."""
    if settings.database_url is None:
        settings.data_dir.mkdir(mode=0o700, exist_ok=True)
        shutil.copy(migrated_file, settings.database_place)
    return settings
