import numpy as np
import pytest

from engine.capture.oni.codec import encode_16zt
from engine.capture.oni.reader import OniReader
from engine.capture.oni.writer import OniWriter
from engine.capture.recorder import record
from engine.capture.recording_source import OniFileSource
from engine.core.clock import MonotonicClock
from engine.core.errors import RecordingError, SourceLostError
from tests.support.capture.oni_recordings import color_picture, depth_picture, write_recording

pytestmark = pytest.mark.slow

FRAMES = 15
PERIOD_US = 100_000  # slow enough for a busy machine to lose nothing
SIZE_PX = (160, 120)


def ending_in_a_long_step(index):
    """A picture on whose end the runtime's encoder makes no mistake."""
    picture = depth_picture(index, SIZE_PX)
    picture[-1, -2:] = 3000, 0
    picture[0, 0] = 5000
    return picture


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorder") / "played.oni"
    with OniWriter(path, depth_size=SIZE_PX, color_size=SIZE_PX, fps=10.0, serial="A1") as writer:
        for index in range(FRAMES):
            writer.write_depth(index * PERIOD_US, ending_in_a_long_step(index))
            writer.write_color(index * PERIOD_US + 9000, color_picture(index, SIZE_PX))
    return path


@pytest.fixture(scope="module")
def recorded(played):
    out = played.with_name("recorded.oni")
    return out, record(played, out, seconds=60.0, clock=MonotonicClock())


def depth_frames(path):
    with OniReader(path) as reader:
        return [frame for frame in reader.frames() if frame.is_depth]


def test_the_runtimes_own_recording_holds_every_frame_bit_for_bit(played, recorded):
    originals, copies = depth_frames(played), depth_frames(recorded[0])
    assert len(copies) == FRAMES
    assert all(
        np.array_equal(one.decode_depth(), other.decode_depth()) for one, other in zip(originals, copies, strict=True)
    )


def test_our_encoder_writes_the_very_bytes_the_runtime_writes(recorded):
    payloads = [frame.payload for frame in depth_frames(recorded[0])]
    assert payloads == [encode_16zt(ending_in_a_long_step(index)) for index in range(FRAMES)]


def test_the_recording_is_whole_and_nothing_else_is_left(recorded):
    path, described = recorded
    assert described.damage is None
    assert (described.depth.frames, described.depth.missed_frames) == (FRAMES, 0)
    assert described.color.codec == "JPEG"
    assert sorted(file.name for file in path.parent.iterdir()) == ["played.oni", "recorded.oni"]


def test_the_recording_says_of_which_camera_it_is(recorded):
    path, described = recorded
    assert described.serial == "A1"
    source = OniFileSource(path, clock=MonotonicClock())
    try:
        assert source.open().serial == "A1"
    finally:
        source.close()


def test_the_empty_half_the_runtime_leaves_is_cut_off(recorded):
    path, described = recorded
    assert path.stat().st_size < 1.2 * (described.depth.coded_bytes + described.color.coded_bytes) + 10_000


def test_recording_stops_when_asked_and_is_whole(played, tmp_path):
    reports = []
    described = record(
        played,
        tmp_path / "short.oni",
        seconds=60.0,
        clock=MonotonicClock(),
        on_progress=reports.append,
        is_stop_requested=lambda: len(reports) >= 5,
    )
    assert described.damage is None
    assert 5 <= described.depth.frames < FRAMES
    assert [report.frames for report in reports] == [1, 2, 3, 4, 5]


def test_recording_stops_after_the_seconds_asked_for(played, tmp_path):
    described = record(played, tmp_path / "short.oni", seconds=0.3, clock=MonotonicClock())
    assert 0.3 <= described.duration_s < 1.0


def test_a_source_that_is_not_there_leaves_nothing(tmp_path):
    with pytest.raises(SourceLostError):
        record("1d27/0600@99/99", tmp_path / "a.oni", seconds=1.0, clock=MonotonicClock())
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_source_leaves_an_older_recording_alone(tmp_path):
    source = write_recording(tmp_path / "source.oni", frames=3)
    source.write_bytes(source.read_bytes()[:-10])
    (tmp_path / "out.oni").write_bytes(b"older")
    with pytest.raises(RecordingError, match=r"source\.oni: cut"):
        record(source, tmp_path / "out.oni", seconds=1.0, clock=MonotonicClock())
    assert (tmp_path / "out.oni").read_bytes() == b"older"


def test_a_folder_that_is_not_there_is_named(played, tmp_path):
    with pytest.raises(RecordingError, match="no folder to record to"):
        record(played, tmp_path / "nowhere" / "a.oni", seconds=1.0, clock=MonotonicClock())
