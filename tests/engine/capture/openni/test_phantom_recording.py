"""A volunteer's recording in the real OpenNI2 runtime."""

import numpy as np
import pytest

from engine.capture.oni.reader import OniReader
from engine.capture.openni.source import OpenNiSource
from engine.core.clock import MonotonicClock
from engine.core.errors import FrameTimeoutError, SourceEndedError
from lab.phantom.recording import make_volunteer

pytestmark = pytest.mark.alone


def test_the_real_runtime_plays_every_frame_as_it_was_made(tmp_path):
    short = tmp_path / "short"
    make_volunteer("regular", volunteer=6, seconds=2.1, seed=5, out=short, workers=1)
    with OniReader(short / "recording.oni") as reader:
        depth = [frame for frame in reader.frames() if frame.is_depth]
    source = OpenNiSource(short / "recording.oni", clock=MonotonicClock())
    source.open()
    played = []
    try:
        while True:
            played.append(source.read(2.0))
    except (SourceEndedError, FrameTimeoutError):
        pass
    finally:
        source.close()
    assert [frame.timestamp_us for frame in played] == [frame.timestamp_us for frame in depth]
    for frame, coded in zip(played, depth, strict=True):
        assert np.array_equal(frame.depth_mm, coded.decode_depth())
    assert played[-1].color.shape == (480, 640, 3)
    # The last ones have no colour frame after them to choose from.
    assert max(frame.pair_gap_us for frame in played[:-2]) < 17_500
