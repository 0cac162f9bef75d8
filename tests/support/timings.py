"""How long each test took, over all parts of `make test`.

`pytest --timings FILE` writes one line per test: seconds (set-up, test and teardown together), a tab, the test.
`python -m tests.support.timings FILE...` prints the total of each part and the slowest twenty over all of them.
"""

import sys
from collections import Counter
from pathlib import Path

import pytest

SHOWN = 20


class Timings:
    """Adds up what pytest reports; with xdist in the process that collects the workers' reports."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seconds: Counter[str] = Counter()
        self._skipped: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add a phase of a test."""
        if report.when is not None and not hasattr(report, "context"):  # a subtest's time is in its test's
            self._seconds[report.nodeid] += report.duration
            if report.skipped:
                self._skipped.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        """Write the file, without the tests that were skipped."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        ran = {test: seconds for test, seconds in self._seconds.items() if test not in self._skipped}
        self._path.write_text("".join(f"{seconds:.3f}\t{test}\n" for test, seconds in ran.items()))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--timings``."""
    parser.addoption("--timings", type=Path, metavar="FILE", help="write how long each test took")


def pytest_configure(config: pytest.Config) -> None:
    """Record durations where a file is given, and not in a worker."""
    path = config.getoption("--timings")
    if path is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Timings(path))


def read_timings(path: Path) -> dict[str, float]:
    """Return the seconds of each test in a file that ``--timings`` wrote."""
    rows = (line.split("\t", 1) for line in path.read_text(encoding="utf-8").splitlines())
    return {test: float(seconds) for seconds, test in rows}


def table(parts: dict[str, dict[str, float]]) -> str:
    """Return the total seconds of each part and the slowest tests of all."""
    lines = [f"{name}: {len(tests)} tests, {sum(tests.values()):.0f} s in all" for name, tests in parts.items()]
    slowest = sorted(((seconds, test) for tests in parts.values() for test, seconds in tests.items()), reverse=True)
    lines += [f"The slowest {SHOWN}:", *(f"{seconds:8.1f} s  {test}" for seconds, test in slowest[:SHOWN])]
    return "\n".join(lines)


if __name__ == "__main__":
    given = [Path(word) for word in sys.argv[1:]]
    sys.stdout.write(table({path.stem: read_timings(path) for path in given if path.exists()}) + "\n")
