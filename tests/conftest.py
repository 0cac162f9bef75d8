"""Virtual volunteers, made once on this machine; each process has a copy of its own, to do with as it likes."""

import gc
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

import engine
from engine.phantom.recording import make_volunteer
from service import journals
from tests.db.postgres import (  # noqa: F401 - fixtures for all tests
    database,
    database_kind,
    database_url,
    empty_place,
    migrated_file,
    own_postgres_server,
    place,
    postgres_server,
)
from tests.kept import digest_of, made_once
from tests.routes_once import routes_once

LONGEST = tuple(
    f"tests/{name}.py"
    for name in (
        "contract/test_schemathesis",
        "faults/test_short_campaign",
        "kills/test_short_campaign",
        "qa/test_run",
        "fuzz/test_minute",
        "evaluation/test_speed",
        "evaluation/test_bench_runs",
        "phantom/test_recording",
        "engine_process/test_service",
        "service/test_process",
        "tps/test_whole_fractions",
        "tps/test_real_service",
        "db/test_backup",
    )
)
"""A file is one process's alone (``--dist loadfile``): one of these begun at the end is waited for by all others."""

MAKERS = [Path(engine.__path__[0]) / name for name in ("phantom", "oni", "geometry.py", "laser_plane.py")]


def volunteer(factory: pytest.TempPathFactory, scenario: str, **wishes: object) -> Path:
    """Give a folder with a volunteer, made now if none was kept."""
    wish = (scenario, sorted(wishes.items()), np.__version__, cv2.__version__)
    with made_once(f"volunteer-{scenario}-{digest_of(wish, *MAKERS)}") as (kept, draft):
        if draft is not None:
            make_volunteer(scenario, out=draft / "volunteer", **wishes)
    return Path(shutil.copytree(kept / "volunteer", factory.mktemp(f"volunteer-{scenario}") / scenario))


@pytest.fixture(scope="session", autouse=True)
def _memory_of_the_tests() -> Iterator[None]:
    """Let journals lie in a folder that goes with the tests: what a test leaves behind fills no machine's memory."""
    folder = Path(tempfile.mkdtemp(prefix="tidegate-journals-"))
    before, journals.MEMORY = journals.MEMORY, folder
    yield
    journals.MEMORY = before
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session", autouse=True)
def _what_stays_is_not_looked_through_again() -> Iterator[None]:
    """Leave modules, collected tests and routes out of every search for garbage: each took a tenth of a second."""
    gc.collect()
    gc.freeze()
    with routes_once():
        yield
    gc.unfreeze()


@pytest.fixture(scope="session")
def regular_volunteer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 24 s of volunteer 1 breathing regularly."""
    return volunteer(tmp_path_factory, "regular", volunteer=1, seconds=24.0, seed=1)


@pytest.fixture(scope="session")
def dibh_volunteer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 36 s: 20 s of free breathing, then a deep breath hold."""
    return volunteer(tmp_path_factory, "dibh", volunteer=1, seconds=36.0, seed=1)


@pytest.fixture(scope="session")
def occlusion_volunteer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 36 s: a hand from 20 to 24 s, a hidden sticker from 28 to 32 s."""
    return volunteer(tmp_path_factory, "occlusion", volunteer=1, seconds=36.0, seed=1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files."""
    turn = {path: number for number, path in enumerate(LONGEST)}
    items.sort(key=lambda item: turn.get(item.nodeid.partition("::")[0], len(turn)))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run what is marked so on SQLite and on PostgreSQL."""
    if metafunc.definition.get_closest_marker("both_databases") and "database_kind" in metafunc.fixturenames:
        metafunc.parametrize("database_kind", ["sqlite", "postgresql"], indirect=True)
