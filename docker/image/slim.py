"""Makes the image's Python environment small and quick: ``slim.py SITE_PACKAGES BIN [SOURCES...]``.

Removes what never runs there, and compiles the modules that do: those of Tidegate, and those that its import statements
reach. The rest keeps its source and is compiled by each process that imports it.
"""

import ast
import contextlib
import importlib
import py_compile
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

REMOVED = (
    # Arrow Flight, object stores, ORC, headers and its own tests; Parquet, compute, CSV and IPC stay.
    "pyarrow/libarrow_flight.so*",
    "pyarrow/libarrow_python_flight.so*",
    "pyarrow/libarrow_s3.so*",
    "pyarrow/_flight*",
    "pyarrow/_s3fs*",
    "pyarrow/_gcsfs*",
    "pyarrow/_azurefs*",
    "pyarrow/_hdfs*",
    "pyarrow/_orc*",
    "pyarrow/_dataset_orc*",
    "pyarrow/_substrait*",
    "pyarrow/_pyarrow_cpp_tests*",
    "pyarrow/include",
    "pyarrow/includes",
    "pyarrow/src",
    # Copies of one library that is found by its third name.
    "pyarrow/libarrow_python.so",
    "pyarrow/libarrow_python.so.*.*",
    # Examples, and a picture format that no report uses.
    "pydicom/data/test_files",
    "matplotlib/mpl-data/sample_data",
    "PIL/_avif*",
    "pillow.libs/libavif*",
    # What is for building against a package.
    "**/tests",
    "**/*.pyi",
    "**/*.pyx",
    "**/*.pxi",
    "**/*.pxd",
    "**/*.h",
    "**/*.hpp",
    "**/*.a",
    "**/*.lib",
    "**/__pycache__",
)
STRIP = "/usr/bin/strip"
STRIPPED = ("typst/_typst.abi3.so",)
"""Libraries with a table of symbols that nothing reads."""
KEPT_COMMANDS = ("python", "python3", "python3.11", "tidegate", "tidegate-health")


def main() -> None:
    """Do both, and print the sizes."""
    site, commands, *sources = map(Path, sys.argv[1:])
    before = _size_mb(site)
    _remove(site, own={source.name for source in sources})
    for command in commands.iterdir():
        if command.name not in KEPT_COMMANDS:
            command.unlink()
    slim = _size_mb(site)
    compiled = _compile(sources, site)
    _say(f"{site}: {before} MB, {slim} MB slim, {_size_mb(site)} MB with {compiled} modules compiled")


def _remove(site: Path, own: set[str]) -> None:
    for pattern in REMOVED:
        for path in sorted(site.glob(pattern)):
            if path.relative_to(site).parts[0] in own:
                continue  # the compiled frame path is held against its sources, headers included
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.exists():
                path.unlink()
    for library in filter(Path.exists, (site / name for name in STRIPPED)):
        subprocess.run([STRIP, "--strip-unneeded", library], check=True)  # noqa: S603 - a file of the build's own


def _compile(sources: list[Path], site: Path) -> int:
    """Compile every module that the sources can import, in a form that needs no look at the source."""
    warnings.simplefilter("ignore")
    sys.dont_write_bytecode = True
    for name in sorted({name for source in sources for path in source.rglob("*.py") for name in _imported(path)}):
        with contextlib.suppress(ImportError, SystemExit):  # an optional SDK
            importlib.import_module(name)
    own = {path for source in sources for path in (site / source.name).rglob("*.py")}
    reached = {Path(module.__file__) for module in list(sys.modules.values()) if getattr(module, "__file__", None)}
    wanted = sorted(path for path in own | reached if path.suffix == ".py" and path.is_relative_to(site))
    for path in wanted:
        mode = py_compile.PycInvalidationMode.UNCHECKED_HASH
        py_compile.compile(str(path), doraise=True, invalidation_mode=mode)
    return len(wanted)


def _imported(path: Path) -> set[str]:
    """Return the modules that a file's import statements name, also those inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def _size_mb(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) // 2**20


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
