"""Restores a backup into an empty database and data folder, and verifies it before the commit.

All rows are inserted in one transaction, committed after they have been read back and compared. Files are written
before it; an interrupted restore can be repeated, and identical files are kept.
"""

import os
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlalchemy import Connection, inspect, text
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from engine.core.files import file_sha256, whole_file
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.anchors import note_restore
from service.storage.backup.archive import BackupFile
from service.storage.backup.backup import Progress
from service.storage.backup.layout import ANCHORS, BackupError, BrokenLogError, FilePart, Manifest, OtherRoomError
from service.storage.backup.rows import add_lines, digest_of, tables_of
from service.storage.database import migrations
from service.storage.database.engine import Database
from service.storage.database.migrations import VERSION_TABLE
from service.storage.database.startup import SAMPLES_FOLDER

OWNER_ONLY = 0o600


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """The database, data folder and anchor file to restore to."""

    database: Database
    data_dir: Path
    anchor_file: Path
    room: str = ""


def restore(
    backup: BackupFile,
    target: Target,
    *,
    actor: str,
    name: str,
    progress: Progress,
    takes_broken_log: bool = False,
    takes_other_room: bool = False,
) -> None:
    """Restore a backup and verify it; on an error the database is unchanged.

    ``takes_broken_log`` accepts an audit log that was broken before the backup, ``takes_other_room`` the data of a room
    with another name; all other checks remain.

    Raises
    ------
    BackupError
        The target is not empty, the backup is damaged, of a newer version, or its audit chain is broken.
    """
    manifest = backup.manifest
    _refuse_newer(manifest)
    if not takes_other_room:
        _refuse_other_room(manifest, target.room)
    with target.database.write() as db:
        _refuse_filled(db.connection())
        _write_files(backup, target, progress)
        _restore_rows(db, backup, progress)
        trouble = _chain_trouble(db, manifest)
        if trouble is not None and not takes_broken_log:
            raise BrokenLogError(trouble)
        # Written before the commit: without it the anchor file would not match the restored rows.
        note_restore(target.anchor_file, sequence=manifest.audit_rows, head_hash=manifest.audit_head, source=name)
        audit.append(db, _event(manifest, actor, name, trouble))


def check(backup: BackupFile, folder: Path, progress: Progress) -> None:
    """Restore a backup into a temporary database in ``folder``; raise BackupError if that fails."""
    _refuse_newer(backup.manifest)
    with (
        tempfile.TemporaryDirectory(dir=folder, prefix=".tidegate-check-") as scratch,
        closing(Database(Path(scratch) / "scratch.db", answer_timeout_s=None)) as database,
    ):
        (Path(scratch) / SAMPLES_FOLDER).mkdir()
        for file in backup.manifest.files:
            progress.begin(file.path.partition("/")[0], 1)
            with Path(os.devnull).open("wb") as nowhere:
                backup.copy(file, nowhere)
        with database.write() as db:
            _restore_rows(db, backup, progress)
            trouble = _chain_trouble(db, backup.manifest)
    if trouble is not None:
        raise BrokenLogError(trouble)


def _restore_rows(db: Session, backup: BackupFile, progress: Progress) -> None:
    """Insert the rows, read them back and compare, then upgrade the tables to this version."""
    connection, manifest = db.connection(), backup.manifest
    _read(lambda: migrations.upgrade(connection, manifest.revision))
    tables = {table.name: table for table in tables_of(connection)}
    if tables.keys() != {part.name for part in manifest.tables}:
        msg = f"the backup's tables are not those of revision {manifest.revision}"
        raise BackupError(msg)
    for part in manifest.tables:
        progress.begin(f"table {part.name}", part.rows)
        _read(partial(add_lines, connection, tables[part.name], part, backup.lines(part), progress.advance))
    for part in manifest.tables:
        progress.begin(f"check {part.name}", part.rows)
        found = digest_of(connection, tables[part.name], progress.advance)
        if (found.rows, found.sha256) != (part.rows, part.sha256):
            msg = f"table {part.name} was not restored as it was"
            raise BackupError(msg)
    _check_references(connection)
    _read(lambda: migrations.upgrade(connection, "head"))


def _read(work: Callable[[], None]) -> None:
    """Run work on backup data; turn the errors of a damaged or forged backup into BackupError."""
    try:
        work()
    except (SQLAlchemyError, ValueError, TypeError) as error:
        msg = f"the backup cannot be restored: {type(error).__name__}"
        raise BackupError(msg) from error


def _check_references(connection: Connection) -> None:
    if connection.dialect.name == "sqlite" and connection.execute(text("PRAGMA foreign_key_check")).first() is not None:
        msg = "the backup has rows whose other row is missing"
        raise BackupError(msg)


def _chain_trouble(db: Session, manifest: Manifest) -> str | None:
    found = audit.verify(db)
    if not found.is_intact:
        return f"the backup's audit log is broken: {found.detail}"
    if (found.rows, found.head_hash) != (manifest.audit_rows, manifest.audit_head):
        return "the end of the backup's audit log differs from its manifest"
    return None


def _refuse_other_room(manifest: Manifest, room: str) -> None:
    """Raise OtherRoomError: another room's patients, references and calibrations would be used for this camera."""
    if manifest.room != room:
        msg = f"the backup is of {_words(manifest.room)}, this is {_words(room)} (TIDEGATE_ROOM)"
        raise OtherRoomError(msg)


def _words(room: str) -> str:
    return f"room {room!r}" if room else "a room without a name"


def _refuse_newer(manifest: Manifest) -> None:
    known = list(migrations.titles())
    if manifest.revision not in known:
        msg = (
            f"the backup is of revision {manifest.revision}, made by a newer version ({manifest.software}); "
            f"this version supports up to {known[-1]}"
        )
        raise BackupError(msg)


def _refuse_filled(connection: Connection) -> None:
    names = [name for name in inspect(connection).get_table_names() if name != VERSION_TABLE]
    if names:
        msg = f"the database is not empty ({len(names)} tables): a backup is restored into a new one"
        raise BackupError(msg)


def _write_files(backup: BackupFile, target: Target, progress: Progress) -> None:
    for file in backup.manifest.files:
        progress.begin(file.path.partition("/")[0], 1)
        _write_file(backup, file, target)


def _write_file(backup: BackupFile, file: FilePart, target: Target) -> None:
    is_anchors = file.path == ANCHORS
    path = target.anchor_file if is_anchors else target.data_dir / file.path
    if path.exists():
        if not is_anchors and file_sha256(path) != file.sha256:
            msg = f"{path} is there already, and another: a backup is restored into an empty data folder"
            raise BackupError(msg)
        return  # a file of anchors only grows: the existing one has more than the backup
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with whole_file(path, mode=OWNER_ONLY, is_durable=True) as out:
        backup.copy(file, out)


def _event(manifest: Manifest, actor: str, name: str, trouble: str | None) -> Event:
    detail = {
        "file": name,
        "made_at": manifest.made_at,
        "software": manifest.software,
        "room": manifest.room,
        "revision": manifest.revision,
        "rows": manifest.rows,
        "files": len(manifest.files),
        "audit_rows": manifest.audit_rows,
        "audit_head": manifest.audit_head,
        "audit_trouble": trouble,
    }
    return Event(actor=actor, action="backup.restored", detail=detail)
