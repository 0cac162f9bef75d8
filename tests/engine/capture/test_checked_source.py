"""A camera is checked whenever it is opened, and closed where it is refused."""

from dataclasses import replace

import pytest

from engine.capture.reconnecting import CheckedSource
from engine.core.errors import CameraMismatchError, SourceAwayError, SourceLostError
from tests.support.capture.unplugged_camera import OURS, Room


class Refusal:
    """Refuses every camera but ours."""

    def __call__(self, described):
        if described != OURS:
            raise CameraMismatchError(f"it is {described.serial}")


@pytest.fixture
def room():
    held = Room()
    make = held.make
    held.source._make = lambda: CheckedSource(make(), Refusal())
    yield held
    held.source.close()


def test_the_camera_that_passes_is_used(room):
    assert room.source.open() == OURS
    assert room.source.read(0.1).index == 0
    assert CheckedSource(room.made[0], Refusal()).is_free


def test_another_camera_is_closed_and_refused_when_it_is_opened(room):
    room.described = replace(OURS, serial="B2")
    with pytest.raises(SourceLostError, match="it is B2"):
        room.source.open()
    assert room.made[-1].closed == 1


def test_another_camera_that_is_plugged_in_instead_is_named_and_not_used(room):
    room.source.open()
    room.source.read(0.1)
    room.is_plugged = False
    with pytest.raises(SourceAwayError):
        room.source.read(0.1)
    room.is_plugged, room.described = True, replace(OURS, serial="B2")
    room.looks.release()
    for _ in range(200):
        with pytest.raises(SourceAwayError) as away:
            room.source.read(0.05)
        if "B2" in str(away.value):
            break
    assert "it is B2" in str(away.value)
    assert room.made[-1].closed >= 1
