"""How long each test took, and how much processor time, over all parts of `make test`.

`pytest --timings FILE` writes one line per test (set-up, test and teardown together): seconds, seconds of processor
time, the test, with tabs between. `python -m tests.support.timings FILE...` prints the total of each part, the slowest
twenty tests over all of them, and the twenty files that take most of the processors.
"""

import resource
import sys
import time
from collections import Counter
from collections.abc import Generator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

SHOWN = 20
PROCESSOR = "processor_s"
_BEGUN = pytest.StashKey[float]()


class Timing(NamedTuple):
    """How long a test took, and how much processor time [s]."""

    seconds: float
    processor_s: float


def processor_s() -> float:
    """Return what this process used, and its children that ended: a server is a cost of the test that ends it."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Note the processor time at a test's begin."""
    item.stash[_BEGUN] = processor_s()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """Send what the test used with its last report: xdist's workers write no file."""
    report = yield
    if call.when == "teardown":
        report.user_properties.append((PROCESSOR, processor_s() - item.stash[_BEGUN]))
    return report


class Timings:
    """Adds up what pytest reports; with xdist in the process that collects the workers' reports."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seconds: Counter[str] = Counter()
        self._processor_s: Counter[str] = Counter()
        self._skipped: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add a phase of a test."""
        if report.when is not None and not hasattr(report, "context"):  # a subtest's time is in its test's
            self._seconds[report.nodeid] += report.duration
            self._processor_s[report.nodeid] += sum(used for name, used in report.user_properties if name == PROCESSOR)
            if report.skipped:
                self._skipped.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        """Write the file, without the tests that were skipped."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        ran = {test: seconds for test, seconds in self._seconds.items() if test not in self._skipped}
        lines = (f"{seconds:.3f}\t{self._processor_s[test]:.3f}\t{test}\n" for test, seconds in ran.items())
        self._path.write_text("".join(lines))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--timings``."""
    parser.addoption("--timings", type=Path, metavar="FILE", help="write how long each test took")


def pytest_configure(config: pytest.Config) -> None:
    """Record durations where a file is given, and not in a worker."""
    path = config.getoption("--timings")
    if path is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Timings(path))


def read_timings(path: Path) -> dict[str, Timing]:
    """Return the times of each test in a file that ``--timings`` wrote."""
    rows = (line.split("\t", 2) for line in path.read_text(encoding="utf-8").splitlines())
    return {test: Timing(float(seconds), float(used)) for seconds, used, test in rows}


def table(parts: dict[str, dict[str, Timing]]) -> str:
    """Return the totals of each part, the slowest tests of all, and the files that use the processors most."""
    lines = [f"{name}: {_totals(list(tests.values()))}" for name, tests in parts.items()]
    every = [(timing, test) for tests in parts.values() for test, timing in tests.items()]
    slowest = sorted(every, reverse=True)[:SHOWN]
    lines += [f"The slowest {SHOWN}:", *(f"{timing.seconds:8.1f} s  {test}" for timing, test in slowest)]
    files: Counter[str] = Counter()
    for timing, test in every:
        files[test.partition("::")[0]] += timing.processor_s
    lines += [
        f"Processor time, the first {SHOWN} files:",
        *(f"{s:8.1f} s  {file}" for file, s in files.most_common(SHOWN)),
    ]
    return "\n".join(lines)


def _totals(tests: list[Timing]) -> str:
    seconds, used = (sum(column) for column in zip(*tests, strict=True)) if tests else (0.0, 0.0)
    return f"{len(tests)} tests, {seconds:.0f} s in all, {used:.0f} s of processor time"


if __name__ == "__main__":
    given = [Path(word) for word in sys.argv[1:]]
    sys.stdout.write(table({path.stem: read_timings(path) for path in given if path.exists()}) + "\n")
