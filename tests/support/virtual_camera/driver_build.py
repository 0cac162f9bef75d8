"""Builds the driver and lays out a folder of the OpenNI2 runtime that knows it: what ``OPENNI2_REDIST`` names."""

import hashlib
import shutil
import subprocess
from pathlib import Path

from engine.capture.openni.c_api import library_path
from tests.support.build_cache import made_once

HERE = Path(__file__).parent
SOURCES = ("driver.cpp", "camera.h", "pictures.h", "block.h")
HEADERS = Path("/usr/include/openni2")
FLAGS = ("-std=c++17", "-O2", "-Wall", "-Wextra", "-fPIC", "-shared", f"-I{HEADERS}", "-pthread")
PACKAGES = "apt-get install g++ libopenni2-0 libopenni2-dev"


class MissingToolError(RuntimeError):
    """What the driver is built with is not on this machine."""


def redist() -> Path:
    """Return the folder, built first where it is not kept from an earlier run."""
    library = _runtime_file()
    compiler = shutil.which("g++")
    if compiler is None or not (HEADERS / "Driver" / "OniDriverAPI.h").is_file():
        msg = f"the virtual Xtion is built with g++ and OpenNI2's headers: {PACKAGES}"
        raise MissingToolError(msg)
    with made_once(f"driver-{_digest(library)}") as (folder, draft):
        if draft is not None:
            _lay_out(draft, library, compiler)
    return folder


def _runtime_file() -> Path:
    name = library_path()
    if name is None:
        msg = f"the OpenNI2 runtime is missing: {PACKAGES}"
        raise MissingToolError(msg)
    for folder in (Path("/"), Path("/usr/lib/x86_64-linux-gnu"), Path("/usr/lib/aarch64-linux-gnu"), Path("/usr/lib")):
        if (folder / name).is_file():
            return (folder / name).resolve()
    msg = f"the OpenNI2 runtime {name} is not where it is looked for: {PACKAGES}"
    raise MissingToolError(msg)


def _digest(library: Path) -> str:
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    for source in (*(HERE / name for name in SOURCES), Path(__file__), library):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _lay_out(draft: Path, library: Path, compiler: str) -> None:
    drivers = draft / "OpenNI2" / "Drivers"
    drivers.mkdir(parents=True)
    # A copy: the runtime looks for drivers beside the file it was loaded from.
    shutil.copyfile(library, draft / "libOpenNI2.so")
    stock = library.parent / "OpenNI2" / "Drivers" / "libOniFile.so.0"
    if stock.is_file():
        shutil.copyfile(stock, drivers / stock.name)
    out = drivers / "libVirtualXtion.so.0"
    command = [compiler, *FLAGS, str(HERE / SOURCES[0]), "-o", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        msg = f"the virtual Xtion's driver does not compile:\n{done.stderr}"
        raise MissingToolError(msg)
