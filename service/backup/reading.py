"""A backup file read back: whole, ours, and every part as its manifest says."""

import hashlib
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO

from pydantic import ValidationError

from service.backup.layout import (
    MANIFEST,
    MAX_MANIFEST_BYTES,
    BackupError,
    FilePart,
    Manifest,
    TablePart,
    is_file_place,
    table_entry,
)

PIECE_BYTES = 1024 * 1024
MAX_LINE_BYTES = 256 * 1024 * 1024
MOST_ENTRIES = 1_000_000
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError, struct.error, MemoryError)
"""What comes out of a ZIP archive that is cut, bent, encrypted, or none."""


class BackupFile:
    """An open backup; every reading ends with a look at its hash."""

    def __init__(self, archive: zipfile.ZipFile, manifest: Manifest) -> None:
        self._archive = archive
        self.manifest = manifest

    def lines(self, table: TablePart) -> Iterator[bytes]:
        """Read a table's lines; raise BackupError at the end if they are not those that were written."""
        digest, rows = hashlib.sha256(), 0
        with self._opened(table_entry(table.name)) as source:
            while rows <= table.rows and (line := source.line()):
                digest.update(line)
                rows += 1
                yield line
        if (rows, digest.hexdigest()) != (table.rows, table.sha256):
            msg = f"table {table.name} of the backup is not what its manifest says"
            raise BackupError(msg)

    def copy(self, file: FilePart, out: BinaryIO) -> None:
        """Read a file into another; raise BackupError if it is not the one that was written."""
        digest, size = hashlib.sha256(), 0
        with self._opened(file.path) as source:
            # Not a byte more than it says: what a few bytes unpack to may fill a disk.
            while size <= file.bytes and (piece := source.piece()):
                digest.update(piece)
                size += len(piece)
                out.write(piece)
        if (size, digest.hexdigest()) != (file.bytes, file.sha256):
            msg = f"{file.path} of the backup is not what its manifest says"
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
    """One entry of the archive; what its reading fails with is told as damage, what its reader fails with is not."""

    def __init__(self, name: str, source: IO[bytes]) -> None:
        self._name = name
        self._source = source

    def line(self) -> bytes:
        """Read the next line; empty at the end."""
        try:
            return self._source.readline(MAX_LINE_BYTES)
        except DAMAGED as error:
            raise _damaged(self._name) from error

    def piece(self) -> bytes:
        """Read the next bytes; empty at the end."""
        try:
            return self._source.read(PIECE_BYTES)
        except DAMAGED as error:
            raise _damaged(self._name) from error


def _damaged(name: str) -> BackupError:
    return BackupError(f"{name} of the backup is damaged")


@contextmanager
def opened(path: Path) -> Iterator[BackupFile]:
    """Open a backup.

    Raises
    ------
    BackupError
        The file cannot be read, was cut off, or is no backup of ours.
    """
    try:
        archive = zipfile.ZipFile(path)
    except DAMAGED as error:
        msg = f"{path} is no backup, or was cut off"
        raise BackupError(msg) from error
    with archive:
        if len(archive.filelist) > MOST_ENTRIES:
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
        if not is_file_place(file.path):
            msg = f"{path} names a file that no backup of ours holds: {file.path[:80]!r}"
            raise BackupError(msg)
    return manifest
