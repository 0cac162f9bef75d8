"""A virtual Xtion of a test's own; the driver is built and the film baked once a machine."""

import shutil

import pytest

from tests.support.virtual_camera.camera import VirtualXtion


@pytest.fixture
def camera(tmp_path):
    assert shutil.which("g++"), "the virtual Xtion is built with g++: apt-get install g++ libopenni2-0 libopenni2-dev"
    with VirtualXtion(tmp_path) as held:
        yield held
