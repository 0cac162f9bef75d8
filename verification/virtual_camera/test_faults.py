"""What goes wrong on the way: each fault as the product's own live source meets it, and what the receipt says of it."""

import time
from itertools import pairwise

import pytest

from tests.support.capture.oni_recordings import write_recording
from tests.support.virtual_camera.block import Call, Field, Kind, State, Streams
from tests.support.virtual_camera.camera import CameraSilentError, VirtualXtion
from tests.support.virtual_camera.viewer import Onlooker, look

pytestmark = pytest.mark.alone

MS = 1_000_000


@pytest.fixture
def onlooker(camera):
    with Onlooker(camera) as held:
        held.until_frame(3)
        yield held


def soon(camera):
    return camera.status.index[0] + 8


def frame_of(onlooker, index):
    return next((frame for frame in onlooker.frames if frame["device_index"] == index), None)


def test_frames_are_lost_exactly_where_requested_and_their_numbers_show_it(camera, onlooker):
    first = soon(camera)
    receipt = camera.skip(5, from_frame=first)
    onlooker.until_frame(first + 10)
    seen = [frame["device_index"] for frame in onlooker.frames]
    assert receipt.frame_index == first
    assert not set(seen) & set(range(first, first + 5))
    back = next(frame for frame in onlooker.frames if frame["device_index"] >= first + 5)
    assert back["missed"] >= 5


def test_a_receipt_reports_when_the_first_affected_frame_was_raised(camera, onlooker):
    for _ in range(5):
        receipt = camera.offset(-20.0, for_frames=1)
        onlooker.until_frame(receipt.frame_index + 1)
        frame = frame_of(onlooker, receipt.frame_index)
        if frame is not None:
            break
    before = [one for one in onlooker.frames if one["device_index"] < receipt.frame_index][-1]
    assert before["received_ns"] < receipt.raised_ns < frame["received_ns"]
    assert frame["center_mm"] < before["center_mm"] - 10
    assert receipt.color_ns is None


@pytest.mark.parametrize("streams", [Streams.DEPTH, Streams.COLOR, Streams.BOTH], ids=lambda one: one.name)
def test_a_stalled_stream_stands_still_until_it_is_resumed(camera, onlooker, streams):
    receipt = camera.stall(streams)
    before = camera.status.raised
    time.sleep(0.3)
    after = camera.status.raised
    assert [after[0] == before[0], after[1] == before[1]] == [bool(streams & 1), bool(streams & 2)]
    camera.undo(receipt)
    onlooker.until_frame(camera.status.index[0] + 3)
    if streams is Streams.COLOR:
        standing = [frame["timestamp_us"] - frame["color_timestamp_us"] for frame in onlooker.frames]
        assert max(standing) > 200_000
    else:
        assert max(frame["missed"] for frame in onlooker.frames) >= 6


def test_the_same_picture_comes_again_with_new_times(camera, onlooker):
    receipt = camera.repeat(for_frames=4)
    onlooker.until_frame(receipt.frame_index + 8)
    affected = [one for one in onlooker.frames if 0 <= one["device_index"] - receipt.frame_index < 4]
    assert len({one["depth_crc"] for one in affected}) == 1
    assert len({one["timestamp_us"] for one in affected}) == len(affected) > 1


def test_the_same_frame_comes_again_with_its_old_number_and_time(camera, onlooker):
    camera.again(for_frames=6)
    onlooker.until_frame(camera.status.index[0] + 10)
    again = [(one, two) for one, two in pairwise(onlooker.frames) if one["timestamp_us"] == two["timestamp_us"]]
    assert again
    assert all(one["device_index"] == two["device_index"] for one, two in again)
    assert all(one["depth_crc"] == two["depth_crc"] for one, two in again)


def lag_ms(frame):
    return frame["received_ns"] / MS - frame["timestamp_us"] / 1000


def test_late_frames_keep_their_times_and_the_receipt_the_time_they_were_due(camera, onlooker):
    usual_ms = min(map(lag_ms, onlooker.frames))
    receipt = camera.late(120.0)
    onlooker.until_frame(receipt.frame_index + 5)
    late = [lag_ms(one) - usual_ms for one in onlooker.frames if one["device_index"] >= receipt.frame_index]
    assert min(late) > 115.0
    first = next(one for one in onlooker.frames if one["device_index"] >= receipt.frame_index)
    assert first["received_ns"] - receipt.raised_ns > 115 * MS
    camera.undo(receipt)
    onlooker.until(lambda: lag_ms(onlooker.frames[-1]) - usual_ms < 60.0, "a prompt frame")


def test_a_backlog_grows_from_frame_to_frame(camera, onlooker):
    usual_ms = min(map(lag_ms, onlooker.frames))
    receipt = camera.late(0.0, growing_ms=10.0)
    onlooker.until_frame(receipt.frame_index + 25)
    backlog_ms = {one["device_index"] - receipt.frame_index: lag_ms(one) - usual_ms for one in onlooker.frames}
    assert all(lag > 10.0 * age - 5.0 for age, lag in backlog_ms.items() if age > 0)


def test_fewer_frames_a_second_are_spaced_so(camera, onlooker):
    receipt = camera.rate(10.0)
    onlooker.until_frame(receipt.frame_index + 8)
    slow = [one for one in onlooker.frames if one["device_index"] > receipt.frame_index]
    assert all(
        two["timestamp_us"] - one["timestamp_us"] == 100_000 * (two["device_index"] - one["device_index"])
        for one, two in pairwise(slow)
    )


@pytest.mark.parametrize("jump_us", [-2_000_000, 2_000_000])
def test_the_device_s_clock_jumps(camera, onlooker, jump_us):
    receipt = camera.clock(jump_us)
    onlooker.until_frame(receipt.frame_index + 5)
    jumps = [two["timestamp_us"] - one["timestamp_us"] for one, two in pairwise(onlooker.frames)]
    assert any(abs(jump - jump_us) < 500_000 for jump in jumps)


def test_the_device_s_clock_stands_still(camera, onlooker):
    receipt = camera.stuck_clock(for_frames=6)
    onlooker.until_frame(receipt.frame_index + 9)
    stuck = {one["timestamp_us"] for one in onlooker.frames if 0 <= one["device_index"] - receipt.frame_index < 6}
    assert len(stuck) == 1


@pytest.mark.parametrize("us", [0, 2**50])
def test_any_time_can_be_stated(camera, onlooker, us):
    camera.timestamp(us, for_frames=4)
    onlooker.until(lambda: us in {one["timestamp_us"] for one in onlooker.frames}, str(us))


@pytest.mark.parametrize("jump", [-3, 1000])
def test_frame_numbers_jump(camera, onlooker, jump):
    receipt = camera.index(jump, for_frames=4)
    onlooker.until_frame(receipt.frame_index + 1)
    assert receipt.frame_index in {one["device_index"] for one in onlooker.frames} or jump > 0
    onlooker.until(lambda: onlooker.frames[-1]["device_index"] > receipt.frame_index - jump, "sound numbers")


MALFORMED = {
    "too few bytes": (Field.DATA_SIZE, 1000),
    "no bytes": (Field.DATA_SIZE, 0),
    "a negative size": (Field.DATA_SIZE, -1),
    "narrower": (Field.WIDTH, 320),
    "far wider": (Field.WIDTH, 64_000),
    "no rows": (Field.HEIGHT, 0),
    "far higher": (Field.HEIGHT, 48_000),
    "rows with gaps": (Field.STRIDE, 4096),
    "rows of nothing": (Field.STRIDE, 0),
    "infrared": (Field.SENSOR, 1),
    "no sensor there is": (Field.SENSOR, 99),
    "another format": (Field.FORMAT, 203),
    "no picture": (Field.NO_DATA, 0),
}


def test_malformed_frames_of_every_sort_are_no_frames_and_sound_ones_follow(camera, onlooker):
    for name, (field, value) in MALFORMED.items():
        receipt = camera.malform(field, value, for_frames=4)
        onlooker.until_frame(receipt.frame_index + 6)
        assert onlooker.is_alive, name
        lied = [one for one in onlooker.frames if 0 <= one["device_index"] - receipt.frame_index < 4]
        assert lied == [], name
    assert not any("error" in one for one in onlooker.said)


def test_malformed_colour_leaves_depth_beside_an_old_picture(camera, onlooker):
    receipt = camera.malform(Field.NO_DATA, streams=Streams.COLOR, for_frames=8)
    onlooker.until_frame(receipt.frame_index + 12)
    beside = [one for one in onlooker.frames if 2 <= one["device_index"] - receipt.frame_index < 8]
    assert beside
    assert len({one["color_timestamp_us"] for one in beside}) == 1


def test_a_hung_native_read_delivers_nothing_until_it_comes_back(camera, onlooker):
    receipt = camera.hang(Call.READ)
    assert camera.status.hung_calls == 1
    onlooker.until(lambda: onlooker.said[-1] == {"timeout": True}, "silence")
    time.sleep(0.2)
    assert onlooker.frames[-1]["received_ns"] < receipt.raised_ns + 50 * MS
    camera.undo()
    onlooker.until_frame(camera.status.index[0])
    assert max(one["missed"] for one in onlooker.frames) >= 4


@pytest.mark.parametrize(("state", "words"), [(State.ERROR, "reports an error"), (State.NOT_READY, "is not ready")])
def test_a_device_state_ends_the_reading_and_states_why(camera, onlooker, state, words):
    camera.state(state)
    onlooker.until(lambda: not onlooker.is_alive, "an end")
    assert onlooker.said[-2:] == [
        {"error": "SourceLostError", "words": f"Virtual Xtion {words}"},
        {"closed": True},
    ]


def test_an_unplugged_camera_is_lost_at_once(camera, onlooker):
    receipt = camera.unplug()
    onlooker.until(lambda: not onlooker.is_alive, "an end")
    assert onlooker.said[-2]["words"] == "Virtual Xtion was disconnected"
    assert [one for one in onlooker.frames if one["received_ns"] > receipt.raised_ns] == []


def test_a_camera_that_is_pulled_without_a_word_is_silence(camera, onlooker):
    camera.unplug(is_reported=False)
    onlooker.until(lambda: onlooker.said[-3:] == [{"timeout": True}] * 3, "silence")
    assert onlooker.is_alive


def test_a_camera_that_is_not_there_is_not_listed_and_cannot_be_opened(tmp_path):
    with VirtualXtion(tmp_path, is_plugged=False) as camera:
        assert look(camera, "devices") == []


def test_an_order_that_cannot_be_executed_is_reported(camera):
    with pytest.raises(CameraSilentError, match="STALL"):
        camera.receipt(camera.order(Kind.STALL), Kind.STALL, timeout_s=0.1)


def test_a_new_process_starts_with_a_sound_camera(camera):
    with Onlooker(camera) as first:
        camera.stall()
        first.until(lambda: first.said[-1] == {"timeout": True}, "silence")
    with Onlooker(camera) as second:
        second.until_frame(5)


def test_a_recording_plays_in_the_runtime_beside_the_camera(camera, tmp_path):
    write_recording(tmp_path / "a.oni", frames=12, period_us=100_000)
    said = look(camera, "recording", str(tmp_path / "a.oni"))
    assert (said[0]["kind"], said[0]["is_live"]) == ("openni_file", False)
    assert [one["device_index"] for one in said if "device_index" in one] == list(range(1, 13))
    assert said[-2:] == [{"error": "SourceEndedError", "words": "the recording has ended"}, {"closed": True}]
