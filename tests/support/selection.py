"""Which tests a run takes, by marks of their modules, and in which order it takes them.

``pytest --part NAME`` runs one part, ``pytest --fast`` what `make check` runs. A module is of the part that its
``pytestmark`` names, and else of the first. ``--stage test`` leaves out what is marked ``verification`` or lies in a
folder of such tests, as `make test` does; ``--stage verify`` runs only that, as `make verify` does, and ``--stage lab``
what lies in the lab's folders. A module's text is read for that: one that is left out is not imported. Slow are the
modules so marked, those of the later parts, two folders, and tests with a fixture that needs a system package or a
recording. A new test is fast until one of these says otherwise; `make check` prints its slowest ten, so that one which
does not belong there is seen.
"""

import re
from functools import cache
from pathlib import Path

import pytest

from tests.support.repository import ROOT

PARTS = ("computing", "waiting", "alone")
"""Where no time is judged; what starts services, kills them and waits; what needs a core to itself."""
MODULE_MARKS = re.compile(r"^pytestmark = (\[[^\]]*\]|.*?$)", re.MULTILINE | re.DOTALL)
STAGES = ("test", "verify", "lab")
"""Every behaviour once, within minutes; campaigns, whole programs, whole sessions; the lab and clusters."""
VERIFICATION_FOLDERS = (
    ROOT / "verification",
    ROOT / "tests/lab/simulated_tps",
    *(ROOT / "tests/system" / name for name in ("beam_line", "client", "engine_process", "service", "tls")),
)
"""Folders of which every module is of the second stage."""
LAB_FOLDERS = (ROOT / "tests/lab", ROOT / "tests/system/cluster", ROOT / "tests/system/processors")
"""Folders of the third stage, but for what is of the second: no test that safety.md or hazards.md names."""
SLOW_FOLDERS = (ROOT / "verification", ROOT / "tests/system")
SLOW_FIXTURES = frozenset(
    {
        "postgres_server",
        "own_postgres_server",
        "regular_volunteer",
        "dibh_volunteer",
        "occlusion_volunteer",
        "lit_volunteer",
    }
)
"""A PostgreSQL server is a system package; a recording takes ten seconds to make on a fresh machine."""
STORAGE = "tests/service/storage/"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--fast``, ``--part`` and ``--stage``."""
    parser.addoption("--fast", action="store_true", help="only the fast tests, which need no system package")
    parser.addoption("--part", choices=PARTS, help="only the tests of this part")
    parser.addoption("--stage", choices=STAGES, help="only the tests of `make test`, `make verify` or `make lab`")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import what this run takes no test of."""
    if config.getoption("--fast") and collection_path in SLOW_FOLDERS:
        return True
    if not collection_path.match("test_*.py"):
        return None
    marks, part, stage = module_marks(collection_path), config.getoption("--part"), config.getoption("--stage")
    is_other = part is not None and part not in (marks & set(PARTS) or {PARTS[0]})
    is_other = is_other or (stage is not None and stage != stage_of(collection_path))
    is_slow = config.getoption("--fast") and not marks.isdisjoint({"slow", "verification", *PARTS})
    return True if is_other or is_slow else None


@cache
def module_marks(path: Path) -> frozenset[str]:
    """Return the names of the marks of a module's every test."""
    found = MODULE_MARKS.search(path.read_text(encoding="utf-8"))
    return frozenset(re.findall(r"pytest\.mark\.(\w+)", found[1])) if found else frozenset()


def stage_of(path: Path) -> str:
    """Return which command runs a module of tests."""
    is_there = not set(VERIFICATION_FOLDERS).isdisjoint(path.parents)
    if not is_there and not set(LAB_FOLDERS).isdisjoint(path.parents):
        return STAGES[2]
    return STAGES[is_there or "verification" in module_marks(path)]


def is_slow(item: pytest.Item) -> bool:
    """Whether ``--fast`` leaves this test out."""
    callspec = getattr(item, "callspec", None)
    return (
        item.get_closest_marker("slow") is not None
        or not SLOW_FIXTURES.isdisjoint(getattr(item, "fixturenames", ()))
        or (callspec is not None and callspec.params.get("database_kind") == "postgresql")
    )


def _further_cases_on_postgresql(items: list[pytest.Item]) -> list[pytest.Item]:
    """Return what a second case on PostgreSQL would not find: a rule's values are in no statement of its own.

    Each test that runs on both databases runs there once, with its first case. In the storage package, where the cases
    are statements and damages, all of them do.
    """
    seen: set[str] = set()
    further = []
    for item in items:
        test, _, case = item.nodeid.partition("[")
        if "postgresql" not in case or item.get_closest_marker("both_databases") is None:
            continue
        if test in seen and not test.startswith(STORAGE):
            further.append(item)
        seen.add(test)
    return further


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the longest modules: if one of them begins last, every other process waits for it."""
    left_out = _further_cases_on_postgresql(items)
    if config.getoption("--fast"):
        left_out += [item for item in items if is_slow(item)]
    config.hook.pytest_deselected(items=left_out)
    left = set(items).difference(left_out)
    items[:] = [item for item in items if item in left]
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run what is marked so on SQLite and on PostgreSQL."""
    if metafunc.definition.get_closest_marker("both_databases") and "database_kind" in metafunc.fixturenames:
        metafunc.parametrize("database_kind", ["sqlite", "postgresql"], indirect=True)
