"""Files that are there whole or not at all, also after the machine lost its power."""

import hashlib
import os
from pathlib import Path

PIECE_BYTES = 1024 * 1024


def sync_file(path: Path) -> None:
    """Bring a file's content to the disk."""
    _sync(path, os.O_RDONLY)


def sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk."""
    _sync(folder, os.O_RDONLY | os.O_DIRECTORY)


def put_in_place(partial: Path, path: Path) -> None:
    """Give a file that was written beside it its name."""
    sync_file(partial)
    partial.replace(path)
    sync_folder(path.parent)


def remove(path: Path) -> None:
    """Take a file away for good."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def file_sha256(path: Path) -> str:
    """Hash a file's bytes, a piece at a time."""
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
