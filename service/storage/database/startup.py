"""Upgrade of the database at start-up: the SQLite file is copied first, and each step is logged."""

import contextlib
import logging
import os
import shutil
import sqlite3
import stat
from pathlib import Path

from engine.core.files import put_in_place
from service.core.settings.database_place import shown_place
from service.storage.database.engine import Database
from service.storage.database.migrations import SchemaStatus, schema_status, titles

logger = logging.getLogger(__name__)

SAMPLES_FOLDER = "samples"
MIB = 1024 * 1024
COPY_PAGES = 4096
OTHERS = 0o077


def prepare(database: Database, *, data_dir: Path, min_free_disk_mb: float) -> None:
    """Upgrade the tables to this version, or create them; log an upgrade and copy an SQLite file before it.

    Raises
    ------
    MigrationError
        The tables were made by a newer version.
    """
    _warn_if_readable_by_others(data_dir)
    with database.connect() as connection:
        found = schema_status(connection)
    if found.ahead and found.revision is not None:
        _log_upgrade(database, found)
        if isinstance(database.place, Path):
            _keep_copy(database.place, found.revision, min_free_disk_mb * MIB)
    database.migrate()
    if found.ahead and found.revision is not None:
        logger.warning("the database is at revision %s", found.head)


def _warn_if_readable_by_others(data_dir: Path) -> None:
    with contextlib.suppress(OSError):
        mode = stat.S_IMODE(data_dir.stat().st_mode)
        if mode & OTHERS:
            logger.warning("others on this machine may look into the data folder (mode %o): chmod 700 it", mode)


def _log_upgrade(database: Database, found: SchemaStatus) -> None:
    revision_titles = titles()
    place = shown_place(database.place)
    logger.warning("upgrading the database %s from revision %s to %s", place, found.revision, found.head)
    for revision in found.ahead:
        logger.warning("revision %s: %s", revision, revision_titles[revision])


def _keep_copy(path: Path, revision: str, min_free_bytes: float) -> None:
    """Copy the file if there is room; the copy is a convenience, since the upgrade is transactional."""
    copy = path.with_name(f"{path.stem}-before-upgrade-from-{revision}{path.suffix}")
    size = path.stat().st_size + _size(path.with_name(path.name + "-wal"))
    if shutil.disk_usage(path.parent).free < 2 * size + min_free_bytes:
        logger.warning("no room for a copy of the database before its upgrade (%.0f MiB)", size / MIB)
    else:
        copy_file(path, copy)
        logger.warning("the database as it was is kept as %s", copy.name)


def copy_file(path: Path, copy: Path) -> None:
    """Copy an SQLite database that may be in use; the copy appears only when complete, with mode 0600."""
    partial = copy.with_name(copy.name + ".partial")
    partial.unlink(missing_ok=True)
    os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    try:
        with (
            contextlib.closing(sqlite3.connect(path)) as source,
            contextlib.closing(sqlite3.connect(partial)) as target,
        ):
            source.backup(target, pages=COPY_PAGES)
            target.execute("PRAGMA journal_mode=DELETE")
        put_in_place(partial, copy)
    finally:
        partial.unlink(missing_ok=True)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
