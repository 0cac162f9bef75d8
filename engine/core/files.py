"""Files that are complete or absent, whenever the process ends; and reading of regular files only."""

import errno
import hashlib
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

PIECE_BYTES = 1024 * 1024


def open_plain(path: Path) -> BinaryIO:
    """Open a regular file for reading; raise OSError for a pipe, a device or a folder.

    Opening a pipe would block until a process writes to it; reading a device may have effects.
    """
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError(errno.EINVAL, "no plain file", str(path))
    return os.fdopen(number, "rb")


@contextmanager
def whole_file(path: Path, *, mode: int = 0o666, is_durable: bool = False) -> Iterator[BinaryIO]:
    """Yield a file ``PATH.partial`` to fill; it replaces ``path`` at the end of the block, and is deleted on failure.

    Parameters
    ----------
    mode
        Permissions of the file, less the process's umask.
    is_durable
        Flush content and name to the disk, so that both outlive a power cut.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        partial.unlink(missing_ok=True)
        with os.fdopen(os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode), "w+b") as file:
            yield file
        if is_durable:
            put_in_place(partial, path)
        else:
            partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes | Callable[[BinaryIO], object], *, is_durable: bool = False) -> None:
    """Replace ``path`` by ``content``, or by what a function writes; see :func:`whole_file`."""
    with whole_file(path, is_durable=is_durable) as file:
        if callable(content):
            content(file)
        else:
            file.write(content)


def put_in_place(partial: Path, path: Path) -> None:
    """Flush a file that was written beside ``path`` to the disk, rename it to ``path``, and flush the name."""
    sync_file(partial)
    partial.replace(path)
    sync_folder(path.parent)


def remove(path: Path) -> None:
    """Delete a file, which may be absent; the deletion outlives a power cut."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_file(path: Path) -> None:
    """Flush a file's content to the disk."""
    _sync(path, os.O_RDONLY)


def sync_folder(folder: Path) -> None:
    """Flush a folder's names to the disk."""
    _sync(folder, os.O_RDONLY | os.O_DIRECTORY)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal; the file is read in pieces."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            digest.update(piece)
    return digest.hexdigest()


def _sync(path: Path, flags: int) -> None:
    opened = os.open(path, flags | os.O_CLOEXEC)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
