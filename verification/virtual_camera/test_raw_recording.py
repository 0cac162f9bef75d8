"""A live camera's frames, kept as the engine saw them: its session is run again to the last bit."""

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.capture.oni.reader import describe
from engine.capture.openni.source import OpenNiSource
from engine.capture.recording_source import OniFileSource
from engine.core.clock import MonotonicClock
from service.cli import app
from service.storage.files.motion_models import raw_path
from tests.support.virtual_camera.treatment_room import room

pytestmark = pytest.mark.alone

FRAMES = 300


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    """A room in which a session was learned, armed, held, lost its camera for a while, and was stopped."""
    folder = tmp_path_factory.mktemp("room")
    with room(folder, RECORD_RAW="true", RAW_MIN_FREE_MB="500") as held:
        held.begin()
        held.turn_on()
        held.act("hold")
        held.act("release")
        held.turn_on()
        held.until(lambda: held.detail["summary"]["frames"] >= FRAMES, "enough frames")
        held.stop()
        yield held, folder


def data_dir_of(folder):
    (found,) = {path.parent.parent for path in folder.rglob("replays/*.tape")}
    return found


def test_a_live_session_is_run_again_the_same(lived):
    held, folder = lived
    answer = CliRunner().invoke(app, ["replay", held.session_id, "--data", str(data_dir_of(folder))])
    assert answer.exit_code == 0, answer.output
    frames = held.detail["summary"]["frames"]
    assert f"identical: {frames} frames" in answer.output


def test_its_raw_recording_is_one_that_everything_plays(lived):
    held, folder = lived
    path = raw_path(data_dir_of(folder), held.session_id)
    described = describe(path)
    assert described.damage is None
    assert described.serial == "VIRTUAL-1"
    assert described.depth.frames == held.detail["summary"]["frames"]
    ours, theirs = OniFileSource(path, clock=MonotonicClock()), OpenNiSource(path, clock=MonotonicClock())
    for source in (ours, theirs):
        source.open()
    try:
        mine, other = ours.read(1.0), theirs.read(5.0)
    finally:
        ours.close()
        theirs.close()
    assert mine.timestamp_us == other.timestamp_us
    assert np.array_equal(mine.depth_mm, other.depth_mm)
    assert np.array_equal(mine.color, other.color)
