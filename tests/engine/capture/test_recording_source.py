import threading

import numpy as np
import pytest

from engine.capture.oni import streams
from engine.capture.oni.writer import OniWriter
from engine.capture.recording_source import MAX_LOOK_AHEAD, OniFileSource
from engine.core.clock import NS_PER_S, ManualClock
from engine.core.errors import FrameTimeoutError, RecordingError, SourceEndedError
from tests.support.capture.oni_recordings import (
    PERIOD_US,
    build_old_recording,
    color_picture,
    depth_picture,
    write_recording,
)


def read_all(source):
    frames = []
    try:
        while True:
            frames.append(source.read(1.0))
    except SourceEndedError:
        return frames


@pytest.fixture(params=[False, True], ids=["alone", "helped"])
def opened(request):
    sources = []

    def open_(path, **options):
        source = OniFileSource(path, clock=ManualClock(77), is_helped=request.param, **options)
        source.open()
        sources.append(source)
        return source

    yield open_
    for source in sources:
        source.close()


def write_times(path, depth_us, color_us):
    """Write frames at these times, interleaved in order of time."""
    with OniWriter(path, depth_size=(64, 48), color_size=(64, 48)) as writer:
        for at_us, is_color in sorted([(t, False) for t in depth_us] + [(t, True) for t in color_us]):
            if is_color:
                writer.write_color(at_us, color_picture(1))
            else:
                writer.write_depth(at_us, depth_picture(1))
    return path


def test_every_depth_frame_is_delivered_once_with_its_pictures(tmp_path, opened):
    frames = read_all(opened(write_recording(tmp_path / "a.oni", frames=9, color_codec="NONE")))
    assert [frame.index for frame in frames] == list(range(9))
    assert [frame.device_index for frame in frames] == list(range(1, 10))
    assert [frame.timestamp_us for frame in frames] == [i * PERIOD_US for i in range(9)]
    assert all(np.array_equal(frame.depth_mm, depth_picture(i)) for i, frame in enumerate(frames))
    assert all(np.array_equal(frame.color, color_picture(i)) for i, frame in enumerate(frames))
    assert {frame.received_ns for frame in frames} == {77}


def test_a_repeated_recording_begins_again_and_its_numbers_and_times_go_on(tmp_path, opened):
    path = write_recording(tmp_path / "a.oni", frames=9, color_codec="NONE")
    source = opened(path, is_repeated=True)
    frames = [source.read(1.0) for _ in range(30)]
    assert [frame.index for frame in frames] == list(range(30))
    assert [frame.device_index for frame in frames] == list(range(1, 31))
    assert np.diff([frame.timestamp_us for frame in frames]).tolist() == pytest.approx(
        [PERIOD_US] * 29, rel=2e-3
    )  # the nominal one at the seam
    assert all(abs(frame.color_timestamp_us - frame.timestamp_us) < PERIOD_US for frame in frames)
    assert all(np.array_equal(frame.depth_mm, depth_picture(i % 9)) for i, frame in enumerate(frames))
    assert all(np.array_equal(frame.color, color_picture(i % 9)) for i, frame in enumerate(frames))
    assert {frame.missed_frames for frame in frames} == {0}


def test_a_repeated_recording_that_is_cut_ends_at_the_cut(tmp_path, opened):
    path = write_recording(tmp_path / "a.oni", frames=9)
    path.write_bytes(path.read_bytes()[:-2_000])
    source = opened(path, is_repeated=True)
    assert len(read_to_damage(source)) < 9


def test_depth_gets_the_colour_nearest_in_time_before_or_after(tmp_path, opened):
    path = write_times(tmp_path / "a.oni", [0, 33_000, 66_000, 99_000], [10_000, 35_000, 60_000, 90_000, 110_000])
    assert [frame.color_timestamp_us for frame in read_all(opened(path))] == [10_000, 35_000, 60_000, 90_000]


def test_a_tie_goes_to_the_earlier_colour_frame(tmp_path, opened):
    path = write_times(tmp_path / "a.oni", [20_000], [10_000, 30_000])
    assert read_all(opened(path))[0].color_timestamp_us == 10_000


def test_drifting_streams_are_paired_by_time_not_by_count(tmp_path, opened):
    depth_us = [i * 33_367 for i in range(60)]
    color_us = [5_000 + i * 34_500 for i in range(57)]
    frames = read_all(opened(write_times(tmp_path / "a.oni", depth_us, color_us)))
    expected = [min(color_us, key=lambda t, at=at: abs(t - at)) for at in depth_us]
    assert [frame.color_timestamp_us for frame in frames] == expected


def test_depth_goes_on_when_colour_has_stopped(tmp_path, opened):
    path = write_times(tmp_path / "a.oni", [i * PERIOD_US for i in range(20)], [0, PERIOD_US])
    frames = read_all(opened(path))
    assert len(frames) == 20
    assert frames[-1].color_timestamp_us == PERIOD_US


def test_depth_is_not_held_back_for_ever_by_missing_colour(tmp_path):
    depth_us = [i * PERIOD_US for i in range(MAX_LOOK_AHEAD + 5)]
    path = write_times(tmp_path / "a.oni", depth_us, [depth_us[-1] + 1])
    with pytest.raises(RecordingError, match="no colour frame near depth frame 1"):
        OniFileSource(path, clock=ManualClock()).open()


def test_lost_frames_are_reported_and_the_index_has_no_gap(tmp_path, opened):
    frames = read_all(opened(write_recording(tmp_path / "a.oni", frames=9, lost_depth=frozenset({4, 5}))))
    assert [frame.index for frame in frames] == list(range(7))
    assert [frame.missed_frames for frame in frames] == [0, 0, 0, 2, 0, 0, 0]


def test_an_old_recording_is_delivered_with_its_small_colour(tmp_path, opened):
    path = tmp_path / "old.oni"
    path.write_bytes(build_old_recording())
    frames = read_all(opened(path))
    assert len(frames) == 24
    assert {(frame.depth_mm.shape, frame.color.shape) for frame in frames} == {((480, 640), (240, 320, 3))}
    assert sum(frame.missed_frames for frame in frames) == 3


def test_a_colour_picture_is_decoded_once_however_often_it_is_used(tmp_path, opened, monkeypatch):
    path = write_times(tmp_path / "a.oni", [i * PERIOD_US for i in range(20)], [0, 10 * PERIOD_US])
    decoded = []
    decode = streams.codec.decode_jpeg
    monkeypatch.setattr(streams.codec, "decode_jpeg", lambda *args: decoded.append(1) or decode(*args))
    assert len(read_all(opened(path))) == 20
    assert len(decoded) == 2


@pytest.mark.parametrize("is_helped", [False, True])
def test_only_colour_that_is_wanted_is_decoded_and_by_whom_it_should_be(tmp_path, monkeypatch, is_helped):
    path = write_times(tmp_path / "a.oni", [i * 3 * PERIOD_US for i in range(6)], [i * PERIOD_US for i in range(17)])
    decoders = []
    decode = streams.codec.decode_jpeg
    monkeypatch.setattr(
        streams.codec, "decode_jpeg", lambda *args: decoders.append(threading.current_thread().name) or decode(*args)
    )
    source = OniFileSource(path, clock=ManualClock(), is_helped=is_helped)
    source.open()
    assert len(read_all(source)) == 6
    source.close()
    assert decoders == ["color-decoder_0" if is_helped else "MainThread"] * 6


def read_to_damage(source):
    frames = []
    try:
        while True:
            frames.append(source.read(1.0))
    except RecordingError as error:
        return frames, str(error)


def test_the_frames_before_a_cut_are_delivered_then_the_error_again_and_again(tmp_path, opened):
    path = write_recording(tmp_path / "a.oni", frames=9)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = opened(path)
    frames, words = read_to_damage(source)
    assert all(np.array_equal(frame.depth_mm, depth_picture(i)) for i, frame in enumerate(frames))
    assert len(frames) == 4
    assert words.startswith("a.oni: cut at byte ")
    assert read_to_damage(source) == ([], words)


def test_a_picture_that_does_not_decode_is_named(tmp_path, opened):
    path = tmp_path / "a.oni"
    with OniWriter(path, depth_size=(64, 48), color_size=(64, 48)) as writer:
        writer.write_depth(0, depth_picture(0))
        writer.write_color(0, color_picture(0))
        writer.write_depth_payload(PERIOD_US, b"no picture")
    frames, words = read_to_damage(opened(path))
    assert len(frames) == 1
    assert words.startswith("a.oni: depth frame 2 or its colour frame: depth picture is cut")


def test_a_colour_picture_that_does_not_decode_is_named_after_the_frames_before(tmp_path, opened):
    path = tmp_path / "a.oni"
    with OniWriter(path, depth_size=(64, 48), color_size=(64, 48)) as writer:
        for index in range(4):
            writer.write_depth(index * PERIOD_US, depth_picture(index))
            if index == 2:
                writer.write_color_payload(index * PERIOD_US, b"no picture")
            else:
                writer.write_color(index * PERIOD_US, color_picture(index))
    source = opened(path)
    frames, words = read_to_damage(source)
    assert [frame.index for frame in frames] == [0, 1]
    assert words == "a.oni: depth frame 3 or its colour frame: colour picture is no JPEG of 64x48"
    assert read_to_damage(source) == ([], words)


def test_no_helper_is_left_behind_however_a_recording_is_left(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=9)
    source = OniFileSource(path, clock=ManualClock(), is_helped=True)
    source.open()
    source.read(1.0)
    assert color_decoders() == 1
    source.open()
    source.read(1.0)
    assert color_decoders() == 1
    source.close()
    assert color_decoders() == 0
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(RecordingError):
        source.open()
    assert color_decoders() == 0


def color_decoders():
    return sum(thread.name.startswith("color-decoder") for thread in threading.enumerate())


def test_a_recording_without_colour_is_refused_at_once(tmp_path):
    with OniWriter(tmp_path / "a.oni", depth_size=(64, 48), color_size=None) as writer:
        writer.write_depth(0, depth_picture(0))
    with pytest.raises(RecordingError, match="the recording has no colour stream"):
        OniFileSource(tmp_path / "a.oni", clock=ManualClock()).open()


def test_a_recording_without_frames_is_refused_at_once(tmp_path):
    with pytest.raises(RecordingError, match="holds no frame"):
        OniFileSource(write_recording(tmp_path / "a.oni", frames=0), clock=ManualClock()).open()


def test_a_source_can_be_opened_again_and_closed_twice(tmp_path, opened):
    source = opened(write_recording(tmp_path / "a.oni", frames=4))
    first = read_all(source)
    source.close()
    source.close()
    with pytest.raises(SourceEndedError):
        source.read(1.0)
    source.open()
    assert [frame.index for frame in read_all(source)] == [frame.index for frame in first]


def test_the_description_states_what_the_file_is(tmp_path):
    source = OniFileSource(write_recording(tmp_path / "a.oni", frames=2), clock=ManualClock())
    described = source.open()
    source.close()
    assert (described.kind, described.name, described.is_live) == ("recording", "a.oni", False)
    assert (described.depth_size, described.color_size, described.fps) == ((64, 48), (64, 48), 30.0)


class PacedClock(ManualClock):
    """Time passes only by waiting."""

    def __init__(self):
        super().__init__(5 * NS_PER_S)
        self.waits_s = []

    def sleep(self, seconds):
        self.waits_s.append(seconds)
        self.advance_ns(round(seconds * NS_PER_S))


def paced(path, clock):
    source = OniFileSource(path, clock=clock, is_paced=True, sleep=clock.sleep)
    source.open()
    return source


def test_a_paced_recording_takes_its_own_time(tmp_path):
    clock = PacedClock()
    source = paced(write_recording(tmp_path / "a.oni", frames=5), clock)
    received_ns = [frame.received_ns for frame in read_all(source)]
    source.close()
    assert received_ns == [5 * NS_PER_S + i * PERIOD_US * 1000 for i in range(5)]


def test_a_paced_read_gives_up_in_time_and_keeps_the_frame(tmp_path):
    clock = PacedClock()
    source = paced(write_recording(tmp_path / "a.oni", frames=3), clock)
    source.read(1.0)
    with pytest.raises(FrameTimeoutError):
        source.read(0.010)
    assert source.read(1.0).index == 1
    assert sum(clock.waits_s) == pytest.approx(PERIOD_US / 1e6)
    source.close()


def test_a_hole_of_an_hour_is_not_waited_for(tmp_path):
    clock = PacedClock()
    path = write_times(tmp_path / "a.oni", [0, 3_600_000_000, 3_600_033_000], [0, 3_600_000_000])
    source = paced(path, clock)
    frames = read_all_patiently(source)
    source.close()
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert sum(clock.waits_s) < 3.0


def read_all_patiently(source):
    frames = []
    for _ in range(20):
        try:
            frames.append(source.read(10.0))
        except FrameTimeoutError:
            continue
        except SourceEndedError:
            break
    return frames
