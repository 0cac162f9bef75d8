"""Reading of a backup file; every part is checked against the manifest."""

import hashlib
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO

from pydantic import ValidationError

from service.storage.backup.layout import (
    MANIFEST,
    MAX_MANIFEST_BYTES,
    BackupError,
    FilePart,
    Manifest,
    TablePart,
    is_backup_path,
    table_entry,
)

PIECE_BYTES = 1024 * 1024
MAX_LINE_BYTES = 256 * 1024 * 1024
MAX_ENTRIES = 1_000_000
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError, struct.error, MemoryError)
"""Exceptions from a ZIP archive that is truncated, damaged, encrypted, or not one."""


class BackupFile:
    """An open backup; each part is checked against its SHA-256 when it has been read."""

    def __init__(self, archive: zipfile.ZipFile, manifest: Manifest) -> None:
        self._archive = archive
        self.manifest = manifest

    def lines(self, table: TablePart) -> Iterator[bytes]:
        """Yield a table's lines; raise BackupError at the end if their count or hash differs from the manifest."""
        digest, rows = hashlib.sha256(), 0
        with self._opened(table_entry(table.name)) as source:
            while rows <= table.rows and (line := source.line()):
                digest.update(line)
                rows += 1
                yield line
        if (rows, digest.hexdigest()) != (table.rows, table.sha256):
            msg = f"table {table.name} of the backup differs from its manifest"
            raise BackupError(msg)

    def copy(self, file: FilePart, out: BinaryIO) -> None:
        """Copy a file to ``out``; raise BackupError if its size or hash differs from the manifest."""
        digest, size = hashlib.sha256(), 0
        with self._opened(file.path) as source:
            # Bounded by the stated size: a few compressed bytes may expand to fill the disk.
            while size <= file.bytes and (piece := source.piece()):
                digest.update(piece)
                size += len(piece)
                out.write(piece)
        if (size, digest.hexdigest()) != (file.bytes, file.sha256):
            msg = f"{file.path} of the backup differs from its manifest"
            raise BackupError(msg)

    @contextmanager
    def _opened(self, name: str) -> Iterator["_Entry"]:
        try:
            source = self._archive.open(name)
        except KeyError as error:
            msg = f"{name} is missing in the backup"
            raise BackupError(msg) from error
        except DAMAGED as error:
            raise _damaged(name) from error
        with source:
            yield _Entry(name, source)


class _Entry:
    """One entry of the archive; errors while reading it become BackupError, errors of the consumer do not."""

    def __init__(self, name: str, source: IO[bytes]) -> None:
        self._name = name
        self._source = source

    def line(self) -> bytes:
        """Return the next line; empty at the end."""
        try:
            return self._source.readline(MAX_LINE_BYTES)
        except DAMAGED as error:
            raise _damaged(self._name) from error

    def piece(self) -> bytes:
        """Return up to 1 MiB; empty at the end."""
        try:
            return self._source.read(PIECE_BYTES)
        except DAMAGED as error:
            raise _damaged(self._name) from error


def _damaged(name: str) -> BackupError:
    return BackupError(f"{name} of the backup is damaged")


@contextmanager
def opened(path: Path) -> Iterator[BackupFile]:
    """Open a backup and read its manifest.

    Raises
    ------
    BackupError
        The file cannot be read, is truncated, or is not a Tidegate backup.
    """
    try:
        archive = zipfile.ZipFile(path)
    except DAMAGED as error:
        msg = f"{path} is no backup, or was cut off"
        raise BackupError(msg) from error
    with archive:
        if len(archive.filelist) > MAX_ENTRIES:
            msg = f"{path} is no backup of ours: it has {len(archive.filelist)} entries"
            raise BackupError(msg)
        yield BackupFile(archive, _manifest(path, archive))


def _manifest(path: Path, archive: zipfile.ZipFile) -> Manifest:
    try:
        entry = archive.getinfo(MANIFEST)
        if entry.file_size > MAX_MANIFEST_BYTES:
            msg = f"{path} is no backup of ours: its manifest is too long"
            raise BackupError(msg)
        with archive.open(entry) as source:
            manifest = Manifest.model_validate_json(source.read(MAX_MANIFEST_BYTES))
    except (KeyError, ValidationError, *DAMAGED) as error:
        msg = f"{path} is no backup of ours, or of a newer version"
        raise BackupError(msg) from error
    for file in manifest.files:
        if not is_backup_path(file.path):
            msg = f"{path} names a file that no backup of ours holds: {file.path[:80]!r}"
            raise BackupError(msg)
    return manifest
