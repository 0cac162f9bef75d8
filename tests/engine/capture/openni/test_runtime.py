"""The OpenNI2 runtime itself; without it these tests fail and say what to install."""

import numpy as np
import pytest

from engine.capture.openni import c_api, source as openni
from engine.capture.openni.source import OpenNiSource
from engine.capture.recording_source import OniFileSource
from engine.core.clock import MonotonicClock
from engine.core.errors import RecordingError, RuntimeMissingError, SourceEndedError, SourceLostError
from tests.support.capture.oni_recordings import build_old_recording, write_recording

pytestmark = pytest.mark.alone

# The runtime keeps one frame a stream, so a test machine that is busy for a period loses one. At ten frames a second
# that does not happen.
FRAMES = 12
PERIOD_US = 100_000


def read_all(source):
    described = source.open()
    frames = []
    try:
        while True:
            frames.append(source.read(2.0))
    except SourceEndedError:
        return described, frames
    finally:
        source.close()


def assert_the_same(played, read):
    fields = ("index", "device_index", "missed_frames", "timestamp_us", "color_timestamp_us")
    assert [[getattr(frame, field) for field in fields] for frame in played] == [
        [getattr(frame, field) for field in fields] for frame in read
    ]
    assert all(np.array_equal(one.depth_mm, other.depth_mm) for one, other in zip(played, read, strict=True))
    assert all(np.array_equal(one.color, other.color) for one, other in zip(played, read, strict=True))


@pytest.mark.parametrize(("depth_codec", "color_codec"), [("16zT", "JPEG"), ("NONE", "NONE")])
def test_the_runtime_plays_what_we_write_and_our_reader_reads_the_same_bits(tmp_path, depth_codec, color_codec):
    path = write_recording(
        tmp_path / "a.oni",
        frames=FRAMES,
        period_us=PERIOD_US,
        size_px=(160, 120),
        depth_codec=depth_codec,
        color_codec=color_codec,
    )
    described, played = read_all(OpenNiSource(path, clock=MonotonicClock()))
    _, read = read_all(OniFileSource(path, clock=MonotonicClock()))
    assert len(played) == FRAMES
    assert_the_same(played, read)
    assert (described.kind, described.is_live, described.depth_size) == ("openni_file", False, (160, 120))


@pytest.mark.parametrize("color_offset_us", [30_000, 48_000, 93_000])
def test_both_ways_pair_depth_with_the_same_colour(tmp_path, color_offset_us):
    path = write_recording(tmp_path / "a.oni", frames=FRAMES, period_us=PERIOD_US, color_offset_us=color_offset_us)
    _, played = read_all(OpenNiSource(str(path), clock=MonotonicClock()))
    _, read = read_all(OniFileSource(path, clock=MonotonicClock()))
    assert_the_same(played, read)


def test_lost_frames_are_reported_alike(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=FRAMES, period_us=PERIOD_US, lost_depth=frozenset({5, 6, 9}))
    _, played = read_all(OpenNiSource(path, clock=MonotonicClock()))
    _, read = read_all(OniFileSource(path, clock=MonotonicClock()))
    assert sum(frame.missed_frames for frame in played) == 3
    assert_the_same(played, read)


def test_an_old_recording_plays_as_it_reads(tmp_path):
    path = tmp_path / "old.oni"
    path.write_bytes(build_old_recording(period_us=PERIOD_US, frames=15))
    _, played = read_all(OpenNiSource(path, clock=MonotonicClock()))
    _, read = read_all(OniFileSource(path, clock=MonotonicClock()))
    assert len(played) == 12
    assert_the_same(played, read)


def test_frames_are_stamped_with_the_clock_in_the_recordings_own_time(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=FRAMES, period_us=PERIOD_US)
    before_ns = MonotonicClock().now_ns()
    _, played = read_all(OpenNiSource(path, clock=MonotonicClock()))
    stamps_ns = [frame.received_ns for frame in played]
    assert before_ns < stamps_ns[0]
    assert stamps_ns == sorted(stamps_ns)
    # Not a speed test: the runtime holds frames back, so playing cannot take much less than the recording's time.
    assert stamps_ns[-1] - stamps_ns[0] > 0.5 * (FRAMES - 1) * PERIOD_US * 1000


def test_frames_do_not_change_after_they_were_delivered(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=FRAMES, period_us=PERIOD_US)
    source = OpenNiSource(path, clock=MonotonicClock())
    source.open()
    first = source.read(2.0)
    copy = first.depth_mm.copy()
    for _ in range(FRAMES - 1):
        source.read(2.0)
    source.close()
    assert np.array_equal(first.depth_mm, copy)
    assert not first.depth_mm.flags.writeable


def test_a_source_can_be_opened_and_closed_again_and_again(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=FRAMES, period_us=PERIOD_US)
    source = OpenNiSource(path, clock=MonotonicClock())
    for _ in range(4):
        source.open()
        assert source.read(2.0).index == 0
        source.close()
        source.close()
    with pytest.raises(SourceLostError, match="not open"):
        source.read(0.1)


def test_a_damaged_file_never_reaches_the_runtime(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=FRAMES, period_us=PERIOD_US)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(RecordingError, match=r"a\.oni: cut at byte"):
        OpenNiSource(path, clock=MonotonicClock()).open()


@pytest.mark.parametrize("content", [b"", b"version https://git-lfs.github.com/spec/v1\n"], ids=["empty", "lfs"])
def test_a_file_that_is_no_recording_is_refused(tmp_path, content):
    path = tmp_path / "a.oni"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"^a\.oni: "):
        OpenNiSource(path, clock=MonotonicClock()).open()


def test_a_device_that_is_not_there_is_lost():
    with pytest.raises(SourceLostError, match="cannot be opened by OpenNI2"):
        OpenNiSource("1d27/0600@99/99", clock=MonotonicClock()).open()


def test_files_that_were_played_are_not_listed_as_devices(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=3)
    read_all(OpenNiSource(path, clock=MonotonicClock()))
    assert not [device for device in openni.list_devices() if device.uri.endswith(".oni")]


def test_a_missing_runtime_states_what_to_install(monkeypatch, tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=1)
    monkeypatch.setattr(c_api, "_load", c_api._load.__wrapped__)
    monkeypatch.setattr(c_api, "library_path", lambda: None)
    assert not openni.runtime_available()
    with pytest.raises(RuntimeMissingError, match="apt-get install libopenni2-0"):
        OpenNiSource(path, clock=MonotonicClock()).open()


def test_a_library_that_is_no_runtime_is_not_one(monkeypatch, tmp_path):
    (tmp_path / "libOpenNI2.so").write_bytes(b"no library")
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    monkeypatch.setattr(c_api, "_load", c_api._load.__wrapped__)
    with pytest.raises(RuntimeMissingError, match="cannot be loaded"):
        openni.list_devices()


def test_the_runtime_is_here():
    assert openni.runtime_available()
