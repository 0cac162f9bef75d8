"""A backup becomes a database and a data folder again: into empty ones alone, proved, and all of it or nothing.

All rows come in one transaction, which is committed once everything has been read back and found equal. Files come
before it, under their own names; a restore that was cut off begins again over those it finds the same.
"""

import hashlib
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

from service import audit
from service.audit import Event
from service.audit.anchors import note_restore
from service.backup.layout import ANCHORS, UNFINISHED, BackupError, BrokenLogError, FilePart, Manifest
from service.backup.making import Progress, sync_folder
from service.backup.reading import BackupFile
from service.backup.rows import add_lines, digest_of, tables_of
from service.db import migrating
from service.db.engine import Database
from service.db.migrating import VERSION_TABLE
from service.db.preparing import SAMPLES_FOLDER

OWNER_ONLY = 0o600


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """Where a backup is restored to."""

    database: Database
    data_dir: Path
    anchor_file: Path


def restore(
    backup: BackupFile, target: Target, *, actor: str, name: str, progress: Progress, takes_broken_log: bool = False
) -> None:
    """Restore a backup and prove it, or leave the database as it was.

    ``takes_broken_log`` is for a site whose log was broken before the backup was made: nothing else can be proved less.

    Raises
    ------
    BackupError
        The target is not empty, the backup is damaged, of a newer version, or its audit chain is broken.
    """
    manifest = backup.manifest
    _refuse_newer(manifest)
    with target.database.write() as db:
        _refuse_filled(db.connection())
        _write_files(backup, target, progress)
        _restore_rows(db, backup, target.data_dir, progress)
        trouble = _chain_trouble(db, manifest)
        if trouble is not None and not takes_broken_log:
            raise BrokenLogError(trouble)
        # Said before the rows are there to be looked at: a file of heads that was never told would cry out at them.
        note_restore(target.anchor_file, sequence=manifest.audit_rows, head_hash=manifest.audit_head, source=name)
        audit.append(db, _event(manifest, actor, name, trouble))


def check(backup: BackupFile, folder: Path, progress: Progress) -> None:
    """Restore a backup into a database that is thrown away, in ``folder``; raise BackupError where that fails."""
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
            _restore_rows(db, backup, Path(scratch), progress)
            trouble = _chain_trouble(db, backup.manifest)
    if trouble is not None:
        raise BrokenLogError(trouble)


def _restore_rows(db: Session, backup: BackupFile, data_dir: Path, progress: Progress) -> None:
    """Bring the rows in, read them back, and bring the tables up to this version's."""
    connection, manifest = db.connection(), backup.manifest
    attributes = {"samples_dir": data_dir / SAMPLES_FOLDER}
    _read(lambda: migrating.upgrade(connection, manifest.revision, attributes))
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
    _read(lambda: migrating.upgrade(connection, "head", attributes))


def _read(work: Callable[[], None]) -> None:
    """Do what a damaged or forged backup makes fail, and say so in plain words."""
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
        return "the backup's audit log does not end where its manifest says"
    return None


def _refuse_newer(manifest: Manifest) -> None:
    known = list(migrating.titles())
    if manifest.revision not in known:
        msg = (
            f"the backup is of revision {manifest.revision}, made by a newer version ({manifest.software}); "
            f"this one knows up to {known[-1]}"
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
        if not is_anchors and _sha256_of(path) != file.sha256:
            msg = f"{path} is there already, and another: a backup is restored into an empty data folder"
            raise BackupError(msg)
        return  # a file of heads only grows: the one that is there knows more than the backup
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    draft = path.with_name(path.name + UNFINISHED)
    draft.unlink(missing_ok=True)
    try:
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, OWNER_ONLY), "wb") as out:
            backup.copy(file, out)
            out.flush()
            os.fsync(out.fileno())
        draft.rename(path)
        sync_folder(path.parent)
    finally:
        draft.unlink(missing_ok=True)


def _sha256_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _event(manifest: Manifest, actor: str, name: str, trouble: str | None) -> Event:
    detail = {
        "file": name,
        "made_at": manifest.made_at,
        "software": manifest.software,
        "revision": manifest.revision,
        "rows": manifest.rows,
        "files": len(manifest.files),
        "audit_rows": manifest.audit_rows,
        "audit_head": manifest.audit_head,
        "audit_trouble": trouble,
    }
    return Event(actor=actor, action="backup.restored", detail=detail)
