"""A wall clock of one process's own, to be changed while it runs; the machine's stays as it is."""

import hashlib
import mmap
import os
import shutil
import struct
import subprocess
import tempfile
from pathlib import Path

SOURCE = Path(__file__).with_name("wall_clock.c")
FLAGS = ("-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-Wno-nonnull-compare", "-fPIC", "-shared")
FILE_NAME = "wall-clock"
NS_PER_S = 1_000_000_000


class NoCompilerError(RuntimeError):
    """The shim cannot be built on this machine."""


class WallClock:
    """The file that says how far the clock is off, and what makes a process look at it."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE_NAME
        self._path.write_bytes(bytes(8))

    @property
    def environment(self) -> dict[str, str]:
        return {"LD_PRELOAD": str(_built()), "OWN_WALL_CLOCK": str(self._path)}

    def set(self, ahead_s: float) -> None:
        """Put the clock ahead of the machine's, or behind; at once."""
        with self._path.open("r+b") as file, mmap.mmap(file.fileno(), 8) as shared:
            shared[:] = struct.pack("q", int(ahead_s * NS_PER_S))


def _built() -> Path:
    """Return the library, built where this source was not built before."""
    digest = hashlib.sha256(SOURCE.read_bytes() + " ".join(FLAGS).encode()).hexdigest()[:16]
    library = Path(tempfile.gettempdir()) / f"tidegate-wall-clock-{os.getuid()}-{digest}.so"
    if library.exists():
        return library
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        msg = "the wall clock's shim is built with gcc: apt-get install gcc libc6-dev"
        raise NoCompilerError(msg)
    draft = library.with_suffix(f".{os.getpid()}")
    done = subprocess.run(
        [compiler, *FLAGS, str(SOURCE), "-o", str(draft), "-ldl"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise NoCompilerError(done.stderr)
    draft.replace(library)
    return library
