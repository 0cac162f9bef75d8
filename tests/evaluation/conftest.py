"""A virtual volunteer with a laser's line and a spirometer, made once a test run and shared by all its processes."""

import fcntl
import os

import pytest

from engine.phantom.recording import make_volunteer


@pytest.fixture(scope="session")
def lit_volunteer(tmp_path_factory):
    """Return a folder with 22 s of volunteer 10 at 10 frames a second: quick breaths, so that it is soon learned."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = shared / "volunteer-lit"
    with (shared / "volunteer-lit.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            make_volunteer("regular", volunteer=10, seconds=22.0, fps=10.0, seed=4, out=folder, has_laser=True)
    return folder
