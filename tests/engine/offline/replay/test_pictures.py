"""A replay finds the pictures of a session's frames in the recording that was played, also of a repeated one."""

import numpy as np
import pytest

from engine.capture.recording_source import OniFileSource
from engine.core.clock import ManualClock
from engine.core.errors import RecordingError
from engine.offline.replay.encoding import head_of
from engine.offline.replay.replaying import Pictures
from tests.support.capture.oni_recordings import write_recording


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "a.oni", frames=9, color_codec="NONE")


def test_frames_of_a_repeated_recording_are_found_again(recording):
    source = OniFileSource(recording, clock=ManualClock(), is_repeated=True)
    source.open()
    played = [source.read(1.0) for _ in range(30)]
    source.close()
    pictures = Pictures(recording, lambda head: head.device_index)
    for frame in played[:4] + played[7:]:  # a session may miss some
        found = pictures.frame(head_of(frame))
        assert np.array_equal(found.depth_mm, frame.depth_mm)
        assert np.array_equal(found.color, frame.color)
    pictures.close()


def test_a_frame_of_another_time_is_not_found(recording):
    source = OniFileSource(recording, clock=ManualClock(), is_repeated=True)
    source.open()
    head = head_of([source.read(1.0) for _ in range(12)][-1])
    source.close()
    pictures = Pictures(recording, lambda _head: head.device_index + 1)
    with pytest.raises(RecordingError, match="is not in it"):
        pictures.frame(head)
    pictures.close()
