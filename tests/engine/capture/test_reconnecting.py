"""A camera that is unplugged and comes back: its reader sees one camera, and never another one."""

import threading
from dataclasses import replace

import pytest

from engine.capture.reconnecting import SILENT_NS
from engine.core.clock import NS_PER_MS
from engine.core.errors import FrameTimeoutError, SourceAwayError, SourceLostError
from tests.support.capture.unplugged_camera import OURS, PERIOD_NS, Room


@pytest.fixture
def room():
    held = Room()
    held.source.open()
    yield held
    held.source.close()


def unplug(room):
    room.source.read(0.1)
    room.is_plugged = False
    with pytest.raises(SourceAwayError):
        room.source.read(0.1)


def is_looked_for(room, times):
    for _ in range(times):
        room.looks.release()
        with pytest.raises(SourceAwayError):
            room.source.read(0.05)


def test_frames_pass_through_as_they_are(room):
    frames = [room.source.read(0.1) for _ in range(3)]
    assert [(one.index, one.timestamp_us, one.missed_frames) for one in frames] == [
        (0, 34_000, 0),
        (1, 67_000, 0),
        (2, 100_000, 0),
    ]


def test_a_camera_that_is_not_there_at_first_is_not_waited_for():
    held = Room()
    held.is_plugged = False
    with pytest.raises(SourceLostError):
        held.source.open()


def test_a_lost_camera_is_away_for_as_long_as_it_is_not_back(room):
    room.source.read(0.1)
    room.is_plugged = False
    with pytest.raises(SourceAwayError, match="unplugged"):
        room.source.read(0.1)
    is_looked_for(room, 5)
    assert room.made[0].closed == 1


def test_frames_go_on_along_the_host_s_time_when_it_is_back(room):
    for _ in range(4):
        last = room.source.read(0.1)
    room.is_plugged = False
    with pytest.raises(SourceAwayError):
        room.source.read(0.1)
    room.clock.advance_ns(30 * PERIOD_NS)
    room.is_plugged = True
    back = room.until_back()
    after = room.source.read(0.1)
    away_us = (back.received_ns - last.received_ns) // 1000
    assert back.index == last.index + 1
    assert back.timestamp_us - last.timestamp_us == away_us
    assert back.timestamp_us - back.color_timestamp_us == 500
    assert back.missed_frames == pytest.approx(away_us / 33_333 - 1, abs=0.6)
    assert (after.index, after.missed_frames) == (back.index + 1, 0)
    assert after.timestamp_us - back.timestamp_us == 33_000


def lag_us(frame):
    return frame.received_ns // 1000 - frame.timestamp_us


def lose(room):
    room.is_plugged = False
    with pytest.raises(SourceAwayError):
        room.source.read(0.1)
    room.is_plugged = True


def test_a_last_frame_that_came_late_does_not_make_those_after_the_absence_late(room):
    prompt = room.source.read(0.1)
    room.late_ns = 150 * NS_PER_MS
    late = room.source.read(0.1)
    room.late_ns = 0
    lose(room)
    back = room.until_back()
    assert lag_us(late) == lag_us(prompt) + 150_000
    assert lag_us(back) == pytest.approx(lag_us(prompt), abs=100)
    assert back.timestamp_us > late.timestamp_us


def test_a_device_s_clock_that_fell_behind_for_an_hour_is_not_put_forward_when_it_is_back(room):
    room.source.read(0.1)
    hour_us = 3_600_000_000
    room.clock.advance_ns(hour_us * 1000)
    room.behind_us = 360_000 - hour_us
    last = room.source.read(0.1)
    lose(room)
    back = room.until_back()
    assert lag_us(back) == pytest.approx(lag_us(last), abs=100)


def test_a_camera_that_states_nothing_for_long_is_taken_for_unplugged(room):
    room.source.read(0.1)
    room.is_silent = True
    room.clock.advance_ns(SILENT_NS)
    with pytest.raises(FrameTimeoutError) as silence:
        room.source.read(0.1)
    assert not isinstance(silence.value, SourceAwayError)
    room.clock.advance_ns(1)
    with pytest.raises(SourceAwayError, match="delivered no frame for 3 s"):
        room.source.read(0.1)
    room.is_silent = False
    assert room.until_back().index == 1


def test_a_camera_that_never_showed_a_frame_is_not_given_up_here(room):
    room.is_silent = True
    room.clock.advance_ns(10 * SILENT_NS)
    with pytest.raises(FrameTimeoutError) as silence:
        room.source.read(0.1)
    assert not isinstance(silence.value, SourceAwayError)


@pytest.mark.parametrize("change", [{"serial": "B2"}, {"name": "Other"}, {"depth_size": (2, 3)}], ids=str)
def test_another_camera_is_not_taken_for_this_one(room, change):
    unplug(room)
    room.is_plugged, room.described = True, replace(OURS, **change)
    is_looked_for(room, 3)
    with pytest.raises(SourceAwayError, match="another camera is plugged in"):
        room.source.read(0.01)
    assert all(camera.closed for camera in room.made[1:])
    room.described = OURS
    assert room.until_back().index == 1


@pytest.fixture(params=["unplugged", "silent"])
def nameless(request):
    """Loses a camera without a serial number; returns the room and what was raised."""
    rooms = []

    def lose_it(*, needs_serial):
        held = Room(needs_serial=needs_serial)
        rooms.append(held)
        held.described = replace(OURS, serial="")
        held.source.open()
        held.source.read(0.1)
        held.is_plugged, held.is_silent = request.param != "unplugged", request.param == "silent"
        held.clock.advance_ns(SILENT_NS + 1)
        with pytest.raises((SourceAwayError, SourceLostError)) as lost:
            held.source.read(0.1)
        return held, lost.value

    yield lose_it
    for held in rooms:
        held.source.close()


def test_a_calibrated_camera_without_a_serial_number_does_not_come_back(nameless):
    held, lost = nameless(needs_serial=True)
    assert not isinstance(lost, SourceAwayError)
    assert "it has no serial number: start another session" in str(lost)
    held.source.close()
    assert [camera.closed for camera in held.made] == [1]


def test_without_a_calibration_a_camera_without_a_serial_number_comes_back(nameless):
    held, lost = nameless(needs_serial=False)
    assert isinstance(lost, SourceAwayError)
    held.is_plugged, held.is_silent = True, False
    assert held.until_back().index == 1


def test_a_camera_that_is_back_without_a_picture_is_not_back(room):
    unplug(room)
    room.is_plugged, room.is_silent = True, True
    is_looked_for(room, 3)
    room.is_silent = False
    assert room.until_back().index == 1


def test_whatever_a_driver_raises_it_is_looked_for_on(room):
    unplug(room)
    room.is_plugged = True
    room.source._search._make = lambda: 1 / 0
    is_looked_for(room, 3)
    with pytest.raises(SourceAwayError, match="ZeroDivisionError"):
        room.source.read(0.01)
    room.source._search._make = room.make
    assert room.until_back().index == 1


def test_closing_while_it_is_away_ends_the_search_and_leaves_nothing_open(room):
    unplug(room)
    room.source.close()
    assert not [one for one in threading.enumerate() if one.name == "camera-search"]
    with pytest.raises(SourceLostError):
        room.source.read(0.1)


def test_a_camera_that_was_found_and_never_taken_is_closed(room):
    unplug(room)
    room.is_plugged = True
    search = room.source._search
    while search._found is None:
        room.looks.release()
        threading.Event().wait(0.01)
    room.source.close()
    assert [camera.closed for camera in room.made] == [1] * len(room.made)


def test_opened_again_it_begins_anew(room):
    unplug(room)
    room.is_plugged = True
    room.until_back()
    room.source.open()
    first = room.source.read(0.1)
    assert (first.index, first.timestamp_us, first.missed_frames) == (0, 34_000, 0)


def test_a_camera_whose_driver_hangs_is_not_tried_again_and_again(room):
    room.source.read(0.1)
    room.is_silent = room.hangs = True
    room.clock.advance_ns(SILENT_NS + 1)
    with pytest.raises(SourceAwayError):
        room.source.read(0.1)
    is_looked_for(room, 5)
    with pytest.raises(SourceAwayError, match="hangs in the camera's driver"):
        room.source.read(0.01)
    assert len(room.made) == 1
    room.is_silent = room.hangs = False
    assert room.until_back().index == 1


def test_a_look_that_hangs_is_the_only_one_that_does(room):
    room.source.read(0.1)
    lose(room)
    room.is_silent = room.hangs = True
    room.source._search._left = None  # the lost one was let go of: what hangs is what looks for it
    is_looked_for(room, 8)
    assert len(room.made) == 2
    room.is_silent = room.hangs = False
    assert room.until_back().index == 1
