import numpy as np
import pytest

from engine.capture.oni.reader import OniReader, describe
from engine.core.errors import RecordingError
from tests.support.capture.oni_recordings import (
    COLOR_OFFSET_US,
    PERIOD_US,
    OldRecording,
    build_old_recording,
    color_picture,
    depth_picture,
    write_recording,
)

pytestmark = pytest.mark.slow


def read_all(path):
    with OniReader(path) as reader:
        return list(reader.frames())


def test_every_frame_comes_once_in_order_with_its_time_and_number(tmp_path):
    frames = read_all(write_recording(tmp_path / "a.oni", frames=9))
    depths = [(frame.frame_id, frame.timestamp_us, frame.missed_frames) for frame in frames if frame.is_depth]
    colors = [(frame.frame_id, frame.timestamp_us, frame.missed_frames) for frame in frames if not frame.is_depth]
    assert depths == [(i + 1, i * PERIOD_US, 0) for i in range(9)]
    assert colors == [(i + 1, i * PERIOD_US + COLOR_OFFSET_US, 0) for i in range(9)]


def test_lost_frames_are_counted_by_their_numbers(tmp_path):
    frames = read_all(write_recording(tmp_path / "a.oni", frames=9, lost_depth=frozenset({3, 4, 8})))
    assert [frame.missed_frames for frame in frames if frame.is_depth] == [0, 0, 2, 0, 0, 1]


def test_numbers_that_jump_count_as_lost_frames_even_where_time_does_not(tmp_path):
    path = depth_only(
        tmp_path / "a.oni", records=[(10, 1, frame_fields(33_000 * i, n), b"") for i, n in ((0, 1), (1, 4))]
    )
    assert [frame.missed_frames for frame in read_all(path)] == [0, 2]


@pytest.mark.parametrize("node_record", [2, 12, 13])
@pytest.mark.parametrize("version", [(1, 0, 0, 4), (1, 0, 0, 6), (1, 0, 1, 0)], ids=str)
def test_files_of_older_software_are_read_whole(tmp_path, node_record, version):
    path = tmp_path / "old.oni"
    path.write_bytes(build_old_recording(node_record=node_record, version=version))
    frames = read_all(path)
    depths, colors = [f for f in frames if f.is_depth], [f for f in frames if not f.is_depth]
    assert (len(depths), len(colors)) == (24, 23)
    assert np.array_equal(depths[-1].decode_depth(), depth_picture(26, (640, 480)))
    assert colors[-1].decode_color().shape == (240, 320, 3)


def test_a_hole_in_time_counts_as_lost_frames_even_where_the_numbers_go_on(tmp_path):
    path = tmp_path / "old.oni"
    path.write_bytes(build_old_recording())
    depths = [frame for frame in read_all(path) if frame.is_depth]
    assert [(frame.frame_id, frame.missed_frames) for frame in depths if frame.missed_frames] == [(11, 3)]


def test_raw_colour_of_older_software_is_rgb(tmp_path):
    path = tmp_path / "old.oni"
    path.write_bytes(build_old_recording(color_jpeg=False))
    colors = [frame for frame in read_all(path) if not frame.is_depth]
    assert np.array_equal(colors[3].decode_color(), color_picture(3, (320, 240)))


def test_a_recording_is_described_without_decoding_it(tmp_path):
    path = tmp_path / "old.oni"
    path.write_bytes(build_old_recording())
    described = describe(path)
    assert described.version == "1.0.0.6"
    assert described.damage is None
    assert (described.depth.frames, described.color.frames) == (24, 23)
    assert (described.depth.codec, described.color.codec) == ("16zT", "JPEG")
    assert (described.color.width, described.color.height) == (320, 240)
    assert described.depth.has_shift_table
    assert described.depth.measured_fps == pytest.approx(1e6 / PERIOD_US)
    assert [(gap.after_frame, gap.missed_frames) for gap in described.depth.gaps] == [(10, 3)]
    assert described.duration_s == pytest.approx(26 * PERIOD_US / 1e6)


def depth_only(path, **changes):
    recording = OldRecording(version=(1, 0, 1, 0))
    recording.node(1, 2, "Depth", changes.get("codec", b"16zT"), 9)
    recording.general(1, "xnMapOutputMode", changes.get("mode", b"\x40\0\0\0\x30\0\0\0\x1e\0\0\0"))
    recording.general(1, "xnCropping", changes.get("cropping", bytes(12)))
    recording.integer(1, "oniPixelFormat", changes.get("pixel_format", 100))
    recording.record(9, 1)
    for kind, node, fields, payload in changes.get("records", ()):
        recording.record(kind, node, fields, payload)
    recording.record(11, 0)
    path.write_bytes(recording.bytes)
    return path


def frame_fields(timestamp_us, frame_id):
    return timestamp_us.to_bytes(8, "little") + frame_id.to_bytes(4, "little")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mode": b"\xff" * 12}, "pictures of 4294967295x4294967295 are not possible"),
        ({"mode": b"\x00" * 12}, "pictures of 0x0 are not possible"),
        ({"mode": b"\x40"}, "the picture size is 1 bytes long"),
        ({"codec": b"16zP"}, "coded as 16zP"),
        ({"pixel_format": 103}, "pixel format 103"),
        ({"cropping": b"\x01" + bytes(11)}, "is cropped"),
        ({"records": [(10, 7, frame_fields(0, 1), b"")]}, "a frame of node 7"),
        ({"records": [(10, 1, b"\0", b"")]}, "a frame without time and number"),
        ({"records": [(10, 1, frame_fields(0, 10), b"")]}, "frame 10 of 9"),
        ({"records": [(10, 1, frame_fields(0, i), b"") for i in (4, 4)]}, "frame 4 comes after frame 4"),
        ({"records": [(10, 1, frame_fields(2**63, 1), b"")]}, "after the end of the recording"),
        ({"records": [(3, 9, b"\3\0\0\0ab\0\x08\0\0\0" + bytes(8), b"")]}, None),
        ({"records": [(6, 1, b"\xff\xff\xff\xff", b"")]}, "GENERAL_PROPERTY is too short"),
    ],
)
def test_each_lie_of_a_file_is_named_in_one_line(tmp_path, changes, words):
    path = depth_only(tmp_path / "lie.oni", **changes)
    if words is None:
        assert read_all(path) == []
        return
    with pytest.raises(RecordingError, match=words) as caught:
        read_all(path)
    assert str(caught.value).startswith("lie.oni: ")
    assert "\n" not in str(caught.value)


def test_depth_in_tenths_of_a_millimetre_comes_in_millimetres(tmp_path):
    raw = np.array([8494, 8495, 0, 12_004], "<u2")
    path = depth_only(
        tmp_path / "a.oni",
        codec=b"NONE",
        mode=b"\x04\0\0\0\x01\0\0\0\x1e\0\0\0",
        pixel_format=101,
        records=[(10, 1, frame_fields(0, 1), raw.tobytes())],
    )
    assert read_all(path)[0].decode_depth().tolist() == [[849, 850, 0, 1200]]


def test_a_recording_without_depth_is_refused(tmp_path):
    recording = OldRecording(version=(1, 0, 1, 0))
    recording.node(1, 3, "Image", b"JPEG", 9)
    recording.record(11, 0)
    (tmp_path / "a.oni").write_bytes(recording.bytes)
    with pytest.raises(RecordingError, match="no depth stream"):
        OniReader(tmp_path / "a.oni")


def test_a_recording_that_states_no_picture_size_is_refused(tmp_path):
    recording = OldRecording(version=(1, 0, 1, 0))
    recording.node(1, 2, "Depth", b"16zT", 9)
    recording.record(11, 0)
    (tmp_path / "a.oni").write_bytes(recording.bytes)
    with pytest.raises(RecordingError, match="announce the size of its pictures"):
        OniReader(tmp_path / "a.oni")


def test_a_picture_size_that_changes_on_the_way_is_damage(tmp_path):
    name = OldRecording().name("xnMapOutputMode")
    mode = b"\x20\0\0\0\x30\0\0\0\x1e\0\0\0"
    path = depth_only(
        tmp_path / "a.oni",
        records=[
            (10, 1, frame_fields(0, 1), b""),
            (6, 1, name + b"\x0c\0\0\0" + mode, b""),
            (10, 1, frame_fields(1, 2), b""),
        ],
    )
    with pytest.raises(RecordingError, match="the picture size changes to 32x48"):
        read_all(path)
