"""The compiled forms of what runs in every frame, where they were built; the numpy forms stand beside their callers.

Both forms give the same measurement within 1e-5 mm. The C sources of this folder are built by ``setup.py`` where there
is a compiler; without one the numpy forms run, at some three times the time. ``TIDEGATE_FRAME_PATH`` chooses:
``auto`` (default) takes the compiled forms where they are built, ``numpy`` never, and ``compiled`` refuses to start
without them.
"""

import hashlib
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from engine.core.errors import InvalidValueError

VARIABLE = "TIDEGATE_FRAME_PATH"
AUTO, COMPILED, NUMPY = "auto", "compiled", "numpy"
CHOICES = (AUTO, COMPILED, NUMPY)
STALE = "numpy (the compiled path was built from other sources: build again)"
NOT_BUILT = "numpy (the compiled path is not built)"
CHOSEN = f"numpy (chosen by {VARIABLE})"


def _source_digest() -> str | None:
    """Return the digest of the sources beside this module, as setup.py computes it; None where there are none."""
    sources = sorted(Path(__file__).parent.glob("*.[ch]"))
    content = b"".join(path.read_bytes() for path in sources)
    return hashlib.sha256(content).hexdigest()[:16] if sources else None


def _load(choice: str) -> tuple[ModuleType | None, str]:
    """Return the compiled functions, None for the numpy forms, and the path's name.

    Raises
    ------
    InvalidValueError
        ``choice`` is none, or asks for the compiled path, which cannot be used.
    """
    if choice not in CHOICES:
        raise InvalidValueError(VARIABLE, choice, ", ".join(CHOICES))
    if choice == NUMPY:
        return None, CHOSEN
    found, name = _built()
    if found is None and choice == COMPILED:
        raise InvalidValueError(VARIABLE, choice, f"possible only where it is built, and here runs {name}")
    return found, name


def _built() -> tuple[ModuleType | None, str]:
    try:
        found = importlib.import_module(f"{__name__}._kernels")
    except ImportError:
        return None, NOT_BUILT
    if _source_digest() not in {None, found.SOURCE_DIGEST}:
        return None, STALE
    return found, f"compiled {found.SOURCE_DIGEST}"


class FramePath:
    """The path that runs in this process: its name, and the compiled functions, None where the numpy forms run.

    An attribute and no call: it is read some forty times a frame.
    """

    kernels, name = _load(os.environ.get(VARIABLE, AUTO))


def frame_path() -> str:
    """Return the name of the path that runs: the compiled one with the digest of its sources, or why it is numpy's."""
    return FramePath.name


@contextmanager
def numpy_forms() -> Iterator[None]:
    """Run the numpy forms inside the block, in the whole process: for comparing both paths."""
    before = FramePath.kernels, FramePath.name
    FramePath.kernels, FramePath.name = None, CHOSEN
    try:
        yield
    finally:
        FramePath.kernels, FramePath.name = before
