"""A virtual Xtion of a test's own; the driver is built and the film baked once a machine."""

import shutil

import pytest

from engine.capture.camera_process import source
from tests.support.virtual_camera.camera import VirtualXtion


@pytest.fixture
def camera(tmp_path):
    assert shutil.which("g++"), "the virtual Xtion is built with g++: apt-get install g++ libopenni2-0 libopenni2-dev"
    with VirtualXtion(tmp_path) as held:
        yield held


@pytest.fixture(autouse=True)
def each_look_is_new(monkeypatch):
    """Ask an SDK each time: a virtual camera comes and goes without the bus."""
    monkeypatch.setattr(source, "LOOK_AGAIN_S", 0.0)
    monkeypatch.setattr(source, "BLIND_LOOK_AGAIN_S", 0.0)
