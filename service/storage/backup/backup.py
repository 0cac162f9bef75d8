"""Creates a backup while the service may run: one snapshot of the database, then the files as they are.

Readers do not block writers in SQLite or PostgreSQL. Rows written after the snapshot are in the next backup. A sample
stream that is closed during the backup is included as Parquet.
"""

import hashlib
import os
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, Literal, Protocol

from sqlalchemy import Connection, Table, select, text

from engine import __version__
from engine.core.files import whole_file
from service.storage.audit import GENESIS_HASH
from service.storage.backup.layout import (
    ANCHORS,
    FOLDERS,
    LEFT_OUT,
    MANIFEST,
    RAW_FOLDER,
    SCHEMA,
    UNFINISHED,
    BackupError,
    FilePart,
    Manifest,
    TablePart,
    is_backup_path,
    table_entry,
)
from service.storage.backup.rows import PIECE, Digest, count, lines, tables_of
from service.storage.database.base import utc_text
from service.storage.database.engine import Database
from service.storage.database.migrations import schema_status
from service.storage.database.tables import AuditRow

PIECE_BYTES = 1024 * 1024
MIB = 1024 * 1024
OWNER_ONLY = 0o600
STREAM, PARQUET = ".arrows", ".parquet"
STARTED = text("SELECT id FROM sessions WHERE started_at IS NOT NULL")
REMOVED = text("SELECT session_id FROM audit WHERE action = 'samples.removed'")


class Progress(Protocol):
    """Receives the progress of a backup or restore."""

    def begin(self, what: str, total: int) -> None:
        """Begin a step with ``total`` units of work."""

    def advance(self, done: int) -> None:
        """Report ``done`` more units of the current step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """The data to back up; ``has_raw`` includes the raw camera frames."""

    database: Database
    data_dir: Path
    anchor_file: Path
    has_raw: bool = False
    room: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CreatedBackup:
    """A completed backup file."""

    manifest: Manifest
    path: Path
    size_bytes: int
    sha256: str


def make_backup(source: Source, out: Path, progress: Progress) -> CreatedBackup:
    """Write a backup; the file appears only when it is complete.

    Raises
    ------
    BackupError
        The file exists or cannot be written, the database has no tables, or a column type is unknown.
    """
    if out.exists():
        msg = f"{out} exists already"
        raise BackupError(msg)
    with _whole(out) as file, zipfile.ZipFile(file, "w", allowZip64=True) as archive:
        manifest = _fill(archive, source, progress)
    digest, size = _sha256_of(out)
    return CreatedBackup(manifest=manifest, path=out, size_bytes=size, sha256=digest)


def needed_bytes(source: Source) -> int:
    """Return an upper estimate of the backup's size [bytes]."""
    with source.database.read() as db:
        sizes = "pg_database_size(current_database())"
        pages = "(SELECT page_count FROM pragma_page_count()) * (SELECT page_size FROM pragma_page_size())"
        tables = db.scalar(text(f"SELECT {sizes if source.database.is_postgresql else pages}")) or 0
    return int(tables) + sum(path.stat().st_size for _, path in _files(source) if path.exists())


def _fill(archive: zipfile.ZipFile, source: Source, progress: Progress) -> Manifest:
    with source.database.read() as db:
        connection = db.connection()
        revision = schema_status(connection).revision
        if revision is None:
            msg = "there is nothing to back up: the database has no tables"
            raise BackupError(msg)
        newest = select(AuditRow.sequence, AuditRow.hash).order_by(AuditRow.sequence.desc()).limit(1)
        head = connection.execute(newest).first()
        tables = [_write_table(archive, connection, table, progress) for table in tables_of(connection)]
        wanted = _sessions_with_files(connection, tables)
    files = _write_files(archive, source, progress)
    present = {Path(file.path).stem for file in files if Path(file.path).suffix in (STREAM, PARQUET)}
    kind: Literal["sqlite", "postgresql"] = "postgresql" if source.database.is_postgresql else "sqlite"
    manifest = Manifest(
        schema=SCHEMA,
        made_at=utc_text(datetime.now(UTC)),
        software=__version__,
        room=source.room,
        database=kind,
        revision=revision,
        audit_rows=0 if head is None else head.sequence,
        audit_head=GENESIS_HASH if head is None else head.hash,
        tables=tables,
        files=files,
        left_out=[*LEFT_OUT, *([] if source.has_raw else [RAW_FOLDER])],
        without_samples=sorted(wanted - present),
    )
    archive.writestr(MANIFEST, manifest.model_dump_json(by_alias=True, indent=1))
    return manifest


def _write_table(archive: zipfile.ZipFile, connection: Connection, table: Table, progress: Progress) -> TablePart:
    progress.begin(f"table {table.name}", count(connection, table))
    digest = Digest()
    entry = _entry(table_entry(table.name), zipfile.ZIP_DEFLATED)
    with archive.open(entry, "w", force_zip64=True) as out:
        for line in lines(connection, table):
            out.write(digest.add(line))
            if digest.rows % PIECE == 0:
                progress.advance(PIECE)
    return digest.part(table)


def _sessions_with_files(connection: Connection, tables: list[TablePart]) -> set[str]:
    """Return the sessions that should have a sample file; empty for older schemas with a samples table."""
    if any(table.name == "samples" for table in tables):
        return set()
    return set(connection.scalars(STARTED)) - set(connection.scalars(REMOVED))


def _write_files(archive: zipfile.ZipFile, source: Source, progress: Progress) -> list[FilePart]:
    """Copy all files; list again until none is new, since closing a session renames its file."""
    tried: set[str] = set()
    written: dict[str, FilePart] = {}
    while new := [(name, path) for name, path in _files(source) if name not in tried]:
        for name, path in new:
            tried.add(name)
            part = _write_file(archive, name, path, progress)
            if part is not None:
                written[name] = part
    return list(written.values())


def _write_file(archive: zipfile.ZipFile, name: str, path: Path, progress: Progress) -> FilePart | None:
    """Copy a file up to its current size; return None if it has been removed."""
    try:
        source = path.open("rb")
    except FileNotFoundError:
        return None
    with source, archive.open(_entry(name, zipfile.ZIP_STORED), "w", force_zip64=True) as out:
        left = size = os.fstat(source.fileno()).st_size
        progress.begin(name.partition("/")[0], size)
        digest = hashlib.sha256()
        while left and (piece := source.read(min(left, PIECE_BYTES))):
            out.write(piece)
            digest.update(piece)
            left -= len(piece)
            progress.advance(len(piece))
    return FilePart(path=name, bytes=size - left, sha256=digest.hexdigest())


def _files(source: Source) -> Iterator[tuple[str, Path]]:
    """Yield the files to back up, with their names in the archive."""
    for folder in (*FOLDERS, *([RAW_FOLDER] if source.has_raw else [])):
        for path in sorted((source.data_dir / folder).glob("*")):
            name = f"{folder}/{path.name}"
            if path.is_file() and path.suffix != UNFINISHED and is_backup_path(name):
                yield name, path
    if source.anchor_file.is_file():
        yield ANCHORS, source.anchor_file


def _entry(name: str, compression: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, date_time=datetime.now(UTC).timetuple()[:6])
    entry.compress_type = compression
    entry.external_attr = OWNER_ONLY << 16
    return entry


@contextmanager
def _whole(out: Path) -> Iterator[BinaryIO]:
    """Yield a file with mode 0600, put in place when complete; raise BackupError if it cannot be written."""
    try:
        with whole_file(out, mode=OWNER_ONLY, is_durable=True) as file:
            yield file
    except OSError as error:
        msg = f"{out} cannot be written ({error.strerror or error})"
        raise BackupError(msg) from error


def _sha256_of(path: Path) -> tuple[str, int]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return digest, file.tell()


def refuse_full_disk(out: Path, needed: int, min_free_disk_mb: float) -> None:
    """Raise BackupError if less than the given free space [MiB] would be left, at which a session's beam is held."""
    free = shutil.disk_usage(out.parent).free
    if free - needed < min_free_disk_mb * MIB:
        msg = (
            f"{out.parent} has {free / MIB:.0f} MiB free; the backup may take {needed / MIB:.0f}, "
            f"and {min_free_disk_mb:g} have to stay free"
        )
        raise BackupError(msg)
