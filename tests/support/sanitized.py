"""The compiled frame path's tests under gcc's address and undefined-behaviour sanitizers.

Run: ``python -m tests.support.sanitized`` (``make sanitize``). A copy of engine and tests is built in a temporary
folder with both sanitizers; a byte read or written beyond an array ends the run with its place in the source.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.support.repository import ROOT

FLAGS = "-fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer -g -O1"
TESTS = (
    "tests/engine/core/test_compiled.py",
    "tests/engine/core/test_replacing.py",
    "tests/engine/capture/oni/test_compiled_decoding.py",
    "tests/engine/motion/test_compiled_forms.py",
)
COPIED = (
    "engine",
    "lab",
    "service",
    "migrations",
    "tests",
    "verification",
    "conftest.py",
    "setup.py",
    "pyproject.toml",
    "README.md",
    "LICENSE",
)


def _library(name: str) -> str:
    found = subprocess.run(["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
    return found.stdout.strip()


def main(*options: str) -> int:
    """Build and run; options go on to pytest. Returns its exit code."""
    with tempfile.TemporaryDirectory(prefix="tidegate-sanitized-") as temporary:
        for name in COPIED:
            source, target = ROOT / name, Path(temporary) / name
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "*.so", "data"))
            else:
                shutil.copy(source, target)
        build = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
        subprocess.run(build, cwd=temporary, env=os.environ | {"CFLAGS": FLAGS, "LDFLAGS": FLAGS}, check=True)
        environment = os.environ | {
            "PYTHONPATH": temporary,
            "LD_PRELOAD": f"{_library('libasan.so')} {_library('libubsan.so')}",
            "ASAN_OPTIONS": "detect_leaks=0",  # the interpreter's own, which it never frees
            "PYTHONMALLOC": "malloc",
            "TIDEGATE_FRAME_PATH": "compiled",
        }
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", *options, *TESTS]
        return subprocess.run(command, cwd=temporary, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
