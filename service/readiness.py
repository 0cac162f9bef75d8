"""Whether a session could run now, and if not, what is missing."""

import shutil
from collections.abc import Callable

from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from service import schemas
from service.db.engine import Database
from service.errors import QaOverdueError
from service.qa.requirement import refuse_without_qa
from service.settings import Settings

MIB = 1024 * 1024


class ReadinessProbe:
    """Looks at the database, the disk, the folders and the audit."""

    def __init__(self, database: Database, settings: Settings, audit_troubles: Callable[[], list[str]] = list) -> None:
        self._database = database
        self._settings = settings
        self._audit_troubles = audit_troubles

    def readiness(self) -> schemas.Readiness:
        """Say what is missing, if anything."""
        missing = [*self._database_trouble(), *self._disk_trouble(), *self._folder_trouble(), *self._qa_trouble()]
        missing += self._audit_troubles()
        return schemas.Readiness(is_ready=not missing, not_ready=missing)

    def _database_trouble(self) -> list[str]:
        try:
            with self._database.write() as db:
                db.execute(text("SELECT 1"))
        except SQLAlchemyError as error:
            return [f"the database cannot be written ({type(error).__name__})"]
        return []

    def _disk_trouble(self) -> list[str]:
        free_mb = shutil.disk_usage(self._settings.data_dir).free / MIB
        if free_mb < self._settings.min_free_disk_mb:
            return [f"only {free_mb:.0f} MiB of disk are free, {self._settings.min_free_disk_mb:g} are needed"]
        return []

    def _qa_trouble(self) -> list[str]:
        try:
            refuse_without_qa(self._database, self._settings)
        except QaOverdueError as error:
            return [str(error)]
        except SQLAlchemyError:
            return []  # told as the database's own trouble
        return []

    def _folder_trouble(self) -> list[str]:
        return [
            f"the recordings folder {path} does not exist"
            for path in self._settings.recordings_dirs
            if not path.is_dir()
        ]
