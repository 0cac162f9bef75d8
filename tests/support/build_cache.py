"""What takes long to make and is the same every time, kept between runs: by a hash of all that it follows from."""

import fcntl
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest


def kept_dir() -> Path:
    """The folder for what is kept, in the machine's temporary files; this user's alone."""
    folder = Path(tempfile.gettempdir()) / f"tidegate-tests-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def run_folder(factory: "pytest.TempPathFactory") -> Path:
    """Return the temporary folder that all processes of this run of the tests share."""
    folder = factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@contextmanager
def made_once(name: str, within: Path | None = None) -> Iterator[tuple[Path, Path | None]]:
    """Give a kept folder, and a draft to fill if it is not there yet: one process makes it, the others wait.

    ``within`` is the folder it lies in, for what is kept for one run only (`run_folder`).
    """
    place = kept_dir() if within is None else within
    folder = place / name
    with (place / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if folder.is_dir():
            yield folder, None
            return
        draft = place / f".{name}-{os.getpid()}"
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir()
        try:
            yield folder, draft
            draft.rename(folder)
        finally:
            shutil.rmtree(draft, ignore_errors=True)


def digest_of(wish: object, *sources: Path) -> str:
    """Hash what was asked for and the sources that make it; a folder is all its modules."""
    digest = hashlib.sha256(repr(wish).encode())
    for source in sources:
        for module in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            digest.update(module.read_bytes())
    return digest.hexdigest()[:16]
