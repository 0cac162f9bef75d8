"""A backup is made beside a running service: one moment of the database, then the files as they are.

Nobody waits for it: SQLite readers do not stand in a writer's way, and PostgreSQL's neither. What is written after that
moment is in the next backup. What was a stream then and is closed while others are copied is in it as Parquet.
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
from service.audit import GENESIS_HASH
from service.backup.layout import (
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
    is_file_place,
    table_entry,
)
from service.backup.rows import PIECE, Digest, count, lines, tables_of
from service.db.base import utc_text
from service.db.engine import Database
from service.db.migrating import standing
from service.db.models import AuditRow

PIECE_BYTES = 1024 * 1024
MIB = 1024 * 1024
OWNER_ONLY = 0o600
STREAM, PARQUET = ".arrows", ".parquet"
STARTED = text("SELECT id FROM sessions WHERE started_at IS NOT NULL")
REMOVED = text("SELECT session_id FROM audit WHERE action = 'samples.removed'")


class Progress(Protocol):
    """Who wants to know how far it is."""

    def begin(self, what: str, total: int) -> None:
        """Hear of a piece of work."""

    def advance(self, done: int) -> None:
        """Hear that so much more of it is done."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """What a backup is made of."""

    database: Database
    data_dir: Path
    anchor_file: Path
    has_raw: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """A backup that lies on the disk."""

    manifest: Manifest
    path: Path
    size_bytes: int
    sha256: str


def make_backup(source: Source, out: Path, progress: Progress) -> Made:
    """Write a backup, whole or not at all.

    Raises
    ------
    BackupError
        There is such a file, or a table has a type that is not known.
    """
    if out.exists():
        msg = f"{out} exists already"
        raise BackupError(msg)
    with _whole(out) as file, zipfile.ZipFile(file, "w", allowZip64=True) as archive:
        manifest = _fill(archive, source, progress)
    digest, size = _sha256_of(out)
    return Made(manifest=manifest, path=out, size_bytes=size, sha256=digest)


def needed_bytes(source: Source) -> int:
    """Estimate, from above, how large a backup becomes."""
    with source.database.read() as db:
        sizes = "pg_database_size(current_database())"
        pages = "(SELECT page_count FROM pragma_page_count()) * (SELECT page_size FROM pragma_page_size())"
        tables = db.scalar(text(f"SELECT {sizes if source.database.is_postgresql else pages}")) or 0
    return int(tables) + sum(path.stat().st_size for _, path in _files(source) if path.exists())


def _fill(archive: zipfile.ZipFile, source: Source, progress: Progress) -> Manifest:
    with source.database.read() as db:
        connection = db.connection()
        revision = standing(connection).revision
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
    """Name the sessions whose samples lie in a file; in older tables they lie in one of their own."""
    if any(table.name == "samples" for table in tables):
        return set()
    return set(connection.scalars(STARTED)) - set(connection.scalars(REMOVED))


def _write_files(archive: zipfile.ZipFile, source: Source, progress: Progress) -> list[FilePart]:
    """Copy all files, looking again until nothing is new: a session that closes meanwhile changes its file's name."""
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
    """Copy a file as long as it is now; None of one that went while we came to it."""
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
    """List the files that belong into a backup, with their names in it."""
    for folder in (*FOLDERS, *([RAW_FOLDER] if source.has_raw else [])):
        for path in sorted((source.data_dir / folder).glob("*")):
            name = f"{folder}/{path.name}"
            if path.is_file() and path.suffix != UNFINISHED and is_file_place(name):
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
    """Fill a file under another name, for its owner alone; it gets its own once all of it is on the disk."""
    partial = out.with_name(out.name + UNFINISHED)
    try:
        partial.unlink(missing_ok=True)
        with os.fdopen(os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL, OWNER_ONLY), "w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.rename(out)
        sync_folder(out.parent)
    except OSError as error:
        msg = f"{out} cannot be written ({error.strerror or error})"
        raise BackupError(msg) from error
    finally:
        partial.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make a file's new name outlive the machine's power."""
    found = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(found)
    finally:
        os.close(found)


def _sha256_of(path: Path) -> tuple[str, int]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return digest, file.tell()


def refuse_full_disk(out: Path, needed: int, min_free_disk_mb: float) -> None:
    """Refuse to begin what would leave the disk as full as holds a running session's beam."""
    free = shutil.disk_usage(out.parent).free
    if free - needed < min_free_disk_mb * MIB:
        msg = (
            f"{out.parent} has {free / MIB:.0f} MiB free; the backup may take {needed / MIB:.0f}, "
            f"and {min_free_disk_mb:g} have to stay free"
        )
        raise BackupError(msg)
