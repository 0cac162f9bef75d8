"""What the live source knows of the driver's queue, through the real runtime."""

import pytest

from tests.support.capture.oni_recordings import write_recording
from tests.support.virtual_camera.viewer import Onlooker, look

pytestmark = pytest.mark.alone

MS = 1_000_000
FRESH_MS = 50


def silent_ms(frame):
    """How long before its receipt the driver was last known to have no frame waiting."""
    return (frame["received_ns"] - frame["queue_empty_ns"]) / MS


def is_fresh(frame):
    return frame["queue_empty_ns"] is not None and silent_ms(frame) < FRESH_MS


def test_frames_of_a_camera_that_waits_for_each_are_fresh(camera):
    with Onlooker(camera) as onlooker:
        onlooker.until(lambda: sum(is_fresh(one) for one in onlooker.frames) > 20, "twenty fresh frames")
        known = [one for one in onlooker.frames if one["queue_empty_ns"] is not None]
    assert all(silent_ms(one) > 0.0 for one in known)
    assert sorted(one["queue_empty_ns"] for one in known) == [one["queue_empty_ns"] for one in known]


def test_a_fresh_frame_was_raised_after_the_silence_before_it(camera):
    with Onlooker(camera) as onlooker:
        onlooker.until_frame(3)
        for _ in range(20):
            receipt = camera.offset(-20.0, for_frames=1)
            onlooker.until_frame(receipt.frame_index + 1)
            found = [one for one in onlooker.frames if one["device_index"] == receipt.frame_index]
            if found and is_fresh(found[0]):
                break
        else:
            pytest.fail("no fresh frame")
    assert found[0]["queue_empty_ns"] < receipt.raised_ns + MS, "its time is noted just before it is raised"
    assert receipt.raised_ns < found[0]["received_ns"]


def test_a_recording_that_the_runtime_plays_shows_nothing_of_a_queue(camera, tmp_path):
    path = tmp_path / "a.oni"
    write_recording(path)
    said = look(camera, "recording", str(path))
    frames = [one for one in said if "device_index" in one]
    assert frames
    assert {one["queue_empty_ns"] for one in frames} == {None}
