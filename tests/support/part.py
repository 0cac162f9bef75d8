"""Runs a part of `make test`; what failed beside other tests is run once more, alone, and named.

A few of ten thousand tests play sessions in real time beside whatever else the machine does. A part is passed if at
most `MOST` tests failed and each of them passes alone; their names end up in `UNSTEADY`; `make test` prints them last.
Such a test, or what it tests, has a race that has to be found: this keeps it from hiding what else was changed.

`python -m tests.support.part NAME ARGUMENT...` runs pytest with the arguments.
"""

import subprocess
import sys
from pathlib import Path

import pytest

MOST = 3
BUILD = Path("build")
UNSTEADY = BUILD / "unsteady.txt"
TESTS_FAILED = 1
"""Pytest's exit code where all tests ran and some failed."""


class Failures:
    """Writes the tests that failed in set-up, test or teardown."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._failed: dict[str, None] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep a test whose phase failed."""
        if report.failed:
            self._failed[report.nodeid] = None

    def pytest_sessionfinish(self) -> None:
        """Write the file."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._path.write_text("".join(f"{test}\n" for test in self._failed))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--failures``."""
    parser.addoption("--failures", type=Path, metavar="FILE", help="write which tests failed")


def pytest_configure(config: pytest.Config) -> None:
    """Record failures where a file is given, and not in a worker."""
    path = config.getoption("--failures")
    if path is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Failures(path))


def run_part(name: str, arguments: list[str]) -> int:
    """Run a part; return 0 where every test passed, beside the others or alone, and else pytest's exit code."""
    failures = BUILD / "failed" / f"{name}.txt"
    failures.unlink(missing_ok=True)
    files = ["--timings", str(BUILD / "timings" / f"{name}.tsv"), "--failures", str(failures)]
    code = _pytest([*files, *arguments])
    failed = failures.read_text(encoding="utf-8").splitlines() if code == TESTS_FAILED and failures.exists() else []
    if not 0 < len(failed) <= MOST:
        return code
    sys.stdout.write(f"{name}: {len(failed)} failed and run once more, alone\n")
    sys.stdout.flush()
    if (again := _pytest(failed)) != 0:
        return again
    with UNSTEADY.open("a", encoding="utf-8") as names:
        names.writelines(f"{test}\n" for test in failed)
    return 0


def _pytest(arguments: list[str]) -> int:
    return subprocess.run([sys.executable, "-m", "pytest", *arguments], check=False).returncode


if __name__ == "__main__":
    sys.exit(run_part(sys.argv[1], sys.argv[2:]))
