"""What the tests of both makers' cameras share: reading a source, and a shim in place of an SDK's package."""

import importlib
import sys
from contextlib import suppress
from types import ModuleType

from engine.capture import DepthSource
from engine.core.errors import FrameTimeoutError
from engine.core.frames import RgbdFrame


def frames(source: DepthSource, count: int) -> list[RgbdFrame]:
    """Read so many frames."""
    return [source.read(5.0) for _ in range(count)]


def until_lost(source: DepthSource) -> None:
    """Read until the source raises."""
    while True:
        with suppress(FrameTimeoutError):
            source.read(0.5)


def real_package(name: str, shim: str) -> ModuleType:
    """Import the wheel's package in place of the one of this name that lies in the folder ``shim``."""
    path, mine = list(sys.path), sys.modules.pop(name)
    sys.path[:] = [one for one in path if one != shim]
    try:
        return importlib.import_module(name)
    finally:
        sys.path[:] = path
        sys.modules[name] = mine
