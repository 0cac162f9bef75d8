"""Where the tests' temporary files are: in memory if the machine has enough, since every commit waits for a disk."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest

MEMORY = Path("/dev/shm")
LEAST_FREE_BYTES = 4 * 1024**3
ROOT_VARIABLE = "PYTEST_DEBUG_TEMPROOT"
"""Pytest's own variable for the folder in which `tmp_path` begins."""


def temporary_root() -> Path:
    """Return the folder for temporary files: a file system in memory that may run programs, or the default."""
    if ROOT_VARIABLE in os.environ:
        return Path(os.environ[ROOT_VARIABLE])
    if MEMORY.is_dir() and os.access(MEMORY, os.W_OK | os.X_OK):
        is_noexec = bool(os.statvfs(MEMORY).f_flag & os.ST_NOEXEC)
        if not is_noexec and shutil.disk_usage(MEMORY).free >= LEAST_FREE_BYTES:
            return MEMORY
    return Path(tempfile.gettempdir())


def pytest_configure(config: pytest.Config) -> None:
    """Set pytest's root for this process and the ones it starts; ``--basetemp`` goes first where it is given."""
    if config.getoption("basetemp") is None:
        os.environ[ROOT_VARIABLE] = str(temporary_root())
