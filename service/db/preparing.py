"""Before a database is used: its tables brought to this version's, a copy of the file kept first, and said aloud."""

import contextlib
import logging
import os
import shutil
import sqlite3
import stat
from pathlib import Path

from service.db.engine import Database
from service.db.migrating import Standing, standing, titles
from service.db.place import shown_place

logger = logging.getLogger(__name__)

SAMPLES_FOLDER = "samples"
MIB = 1024 * 1024
COPY_PAGES = 4096
OTHERS = 0o077


def prepare(database: Database, *, data_dir: Path, min_free_disk_mb: float) -> None:
    """Bring the tables to this version's; says what it does where that is more than making them.

    Raises
    ------
    MigrationError
        The tables were made by a newer version.
    """
    _warn_of_others(data_dir)
    with database.connect() as connection:
        found = standing(connection)
    if found.ahead and found.revision is not None:
        _announce(database, found)
        if isinstance(database.place, Path):
            _keep_copy(database.place, found.revision, min_free_disk_mb * MIB)
    database.migrate(samples_dir=data_dir / SAMPLES_FOLDER)
    if found.ahead and found.revision is not None:
        logger.warning("the database is at revision %s", found.head)


def _warn_of_others(data_dir: Path) -> None:
    with contextlib.suppress(OSError):
        mode = stat.S_IMODE(data_dir.stat().st_mode)
        if mode & OTHERS:
            logger.warning("others on this machine may look into the data folder (mode %o): chmod 700 it", mode)


def _announce(database: Database, found: Standing) -> None:
    words = titles()
    place = shown_place(database.place)
    logger.warning("upgrading the database %s from revision %s to %s", place, found.revision, found.head)
    for revision in found.ahead:
        logger.warning("revision %s: %s", revision, words[revision])


def _keep_copy(path: Path, revision: str, min_free_bytes: float) -> None:
    """Keep the file as it was, where there is room for it; the upgrade itself happens whole or not at all anyway."""
    copy = path.with_name(f"{path.stem}-before-upgrade-from-{revision}{path.suffix}")
    size = path.stat().st_size + _size(path.with_name(path.name + "-wal"))
    if shutil.disk_usage(path.parent).free < 2 * size + min_free_bytes:
        logger.warning("no room for a copy of the database before its upgrade (%.0f MiB)", size / MIB)
    else:
        copy_file(path, copy)
        logger.warning("the database as it was is kept as %s", copy.name)


def copy_file(path: Path, copy: Path) -> None:
    """Copy a SQLite database that may be in use, whole or not at all; readable by its owner alone."""
    partial = copy.with_name(copy.name + ".partial")
    partial.unlink(missing_ok=True)
    os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    try:
        with contextlib.closing(sqlite3.connect(path)) as one, contextlib.closing(sqlite3.connect(partial)) as other:
            one.backup(other, pages=COPY_PAGES)
            other.execute("PRAGMA journal_mode=DELETE")
        _sync(partial)
        partial.replace(copy)
        _sync(copy.parent)
    finally:
        partial.unlink(missing_ok=True)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _sync(path: Path) -> None:
    found = os.open(path, os.O_RDONLY)
    try:
        os.fsync(found)
    finally:
        os.close(found)
