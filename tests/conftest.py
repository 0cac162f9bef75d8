"""Virtual volunteers, made once a test run and shared by all its processes."""

import fcntl
import os
from pathlib import Path

import pytest

from engine.phantom.recording import make_volunteer


def _volunteer(factory: pytest.TempPathFactory, scenario: str, seconds: float) -> Path:
    """Make volunteer 1 in a folder that all workers of this run share; the lock makes the others wait for the first."""
    base = factory.getbasetemp()
    # A worker of pytest-xdist has a folder of its own in the run's.
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = shared / f"volunteer-{scenario}"
    with (shared / f"volunteer-{scenario}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            make_volunteer(scenario, volunteer=1, seconds=seconds, seed=1, out=folder)
    return folder


@pytest.fixture(scope="session")
def regular_volunteer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 24 s of volunteer 1 breathing regularly."""
    return _volunteer(tmp_path_factory, "regular", 24.0)


@pytest.fixture(scope="session")
def dibh_volunteer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 36 s: 20 s of free breathing, then a deep breath hold."""
    return _volunteer(tmp_path_factory, "dibh", 36.0)


@pytest.fixture(scope="session")
def occlusion_volunteer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 36 s: a hand from 20 to 24 s, a hidden sticker from 28 to 32 s."""
    return _volunteer(tmp_path_factory, "occlusion", 36.0)
