"""The data folder that a command works on: it must exist, so that a mistyped name is refused and not created."""

from pathlib import Path

from service.core.errors import NotFoundError
from service.core.settings.settings import Settings, load_settings


def settings_of_folder(data: Path | None) -> Settings:
    """Read the settings of a data folder that exists.

    Parameters
    ----------
    data
        The command's ``--data``; ``TIDEGATE_DATA_DIR`` or the default when None.

    Raises
    ------
    NotFoundError
        The folder does not exist. With PostgreSQL only a folder named in ``--data`` must exist.
    SettingsError
        The settings cannot be used.
    """
    settings = load_settings(data_dir=data)
    is_needed = data is not None or isinstance(settings.database_place, Path)
    if is_needed and not settings.data_dir.is_dir():
        msg = f"there is no data folder {settings.data_dir}: check {'--data' if data else 'TIDEGATE_DATA_DIR'}"
        raise NotFoundError(msg, field="data")
    return settings


def settings_of_database(data: Path | None) -> Settings:
    """Read the settings of a data folder that has a database; raise as `settings_of_folder` where it has none."""
    settings = settings_of_folder(data)
    place = settings.database_place
    if isinstance(place, Path) and not place.is_file():
        msg = f"there is no database in the data folder {settings.data_dir}"
        raise NotFoundError(msg, field="data")
    return settings
