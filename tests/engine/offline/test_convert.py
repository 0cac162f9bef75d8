"""Recordings from format to format: equal pictures, others' readers, and files that are cut off anywhere."""

import json

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory

from engine.calibration import load_calibration
from engine.capture import mcap_file
from engine.capture.mcap_file import COLOR, DEPTH, INFO, McapPictures, McapPictureWriter
from engine.capture.oni.reader import OniReader
from engine.capture.oni.writer import OniWriter
from engine.capture.picture_folder import HEAD_FILE, FolderPictures
from engine.capture.pictures import OniPictures, Picture, RecordingHead
from engine.core.errors import InvalidValueError, RecordingError
from engine.offline import convert_recording as convert

FRAMES, SERIAL = 12, "X-1206"
SIZE = (64, 48)


def depth_of(number):
    picture = np.random.default_rng(number).integers(600, 1200, SIZE[::-1], dtype=np.uint16)
    picture[: number % 7] = 0
    return picture


def color_of(number):
    smooth = cv2.GaussianBlur(
        np.random.default_rng(100 + number).integers(0, 255, (*SIZE[::-1], 3), np.uint8), (9, 9), 0
    )
    return np.ascontiguousarray(smooth)


@pytest.fixture
def oni(tmp_path):
    path = tmp_path / "rec.oni"
    with OniWriter(path, depth_size=SIZE, color_size=SIZE, serial=SERIAL) as writer:
        for number in range(FRAMES):
            at = 1_000_000 + 33_367 * number
            writer.write_depth(at, depth_of(number), frame_id=number + 1 + (number > 5))
            writer.write_color(at + 900, color_of(number), frame_id=number + 1)
    return path


def content(reader):
    """Times, numbers and pictures of a recording, depth and colour apart."""
    with reader:
        found = list(reader.pictures())
        shape = reader.head.depth_size[::-1]
    depth = [(one.timestamp_us, one.frame_id, one.depth_mm) for one in found if one.depth_mm is not None]
    color = [(one.timestamp_us, one.frame_id, one.color(shape)) for one in found if one.depth_mm is None]
    return depth, color


def same(one, other, *, most=0):
    assert [line[:2] for line in one] == [line[:2] for line in other]
    for mine, theirs in zip(one, other, strict=True):
        assert np.abs(mine[2].astype(int) - theirs[2].astype(int)).max() <= most


@pytest.mark.parametrize("way", [("a.mcap", "b.oni"), ("a.mcap", "frames", "b.oni"), ("frames", "a.mcap", "b.oni")])
def test_a_way_round_gives_the_same_recording(tmp_path, oni, way):
    source = oni
    for name in way:
        done = convert(source, tmp_path / name)
        assert (done.depth, done.color, done.serial, done.damage) == (FRAMES, FRAMES, SERIAL, None)
        source = tmp_path / name
    before, after = content(OniPictures(oni)), content(OniPictures(source))
    same(before[0], after[0])
    same(before[1], after[1], most=0 if "frames" not in way else 12)  # through PNG a JPEG is made anew
    with OniReader(source) as reader:
        assert reader.serial == SERIAL


def test_jpeg_pictures_are_handed_on_byte_for_byte(tmp_path, oni):
    convert(oni, tmp_path / "a.mcap")
    with OniReader(oni) as reader:
        given = [bytes(one.payload) for one in reader.frames() if not one.is_depth]
    assert [one.jpeg for one in McapPictures(tmp_path / "a.mcap").pictures() if one.jpeg is not None] == given


def test_a_mirrored_recording_is_written_turned_round(tmp_path, monkeypatch, oni):
    convert(oni, tmp_path / "plain.mcap")
    from dataclasses import replace

    plain = OniReader.depth.fget
    monkeypatch.setattr(OniReader, "depth", property(lambda self: replace(plain(self), is_mirrored=True)))
    convert(oni, tmp_path / "turned.mcap")
    one, other = (content(McapPictures(tmp_path / name))[0] for name in ("plain.mcap", "turned.mcap"))
    same(one, [(at, number, picture[:, ::-1]) for at, number, picture in other])


def test_others_read_it_as_ros_messages_with_depth_in_mm(tmp_path, oni, regular_volunteer):
    calibration = regular_volunteer / "calibration.json"
    path = tmp_path / "a.mcap"
    convert(oni, path, calibration=calibration)
    messages = {}
    with path.open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            messages.setdefault(channel.topic, []).append(message)
    assert {topic: len(found) for topic, found in messages.items()} == {
        DEPTH: FRAMES,
        COLOR: FRAMES,
        INFO[DEPTH]: 1,
        INFO[COLOR]: 1,
    }
    first = messages[DEPTH][0]
    assert first.format == "16UC1; compressedDepth png"
    assert first.header.stamp.sec * 10**6 + first.header.stamp.nanosec // 1000 == 1_000_000
    png = np.frombuffer(bytes(first.data)[12:], np.uint8)
    np.testing.assert_array_equal(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), depth_of(0))
    info = messages[INFO[DEPTH]][0]
    known = load_calibration(calibration)
    np.testing.assert_allclose(np.reshape(info.k, (3, 3)), known.depth.matrix)
    assert (info.width, info.height) == SIZE
    with path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_summary().statistics.message_count == 2 * FRAMES + 2
        (metadata,) = reader.iter_metadata()
        assert metadata.metadata["serial"] == SERIAL
        assert metadata.metadata["mirrored"] == "no"
        (attached,) = reader.iter_attachments()
        assert attached.data == calibration.read_bytes()


def test_the_calibration_comes_along_and_names_the_camera(tmp_path, regular_volunteer, oni):
    document = json.loads((regular_volunteer / "calibration.json").read_text()) | {"serial": "C-77"}
    named = tmp_path / "calibration.json"
    named.write_text(json.dumps(document))
    unnamed = tmp_path / "unnamed.oni"
    with OniWriter(unnamed, depth_size=SIZE, color_size=None) as writer:
        writer.write_depth(5, depth_of(1))
    assert convert(unnamed, tmp_path / "none.mcap").serial == "unknown"
    assert convert(unnamed, tmp_path / "a.mcap", calibration=named).serial == "C-77"
    assert convert(tmp_path / "a.mcap", tmp_path / "frames").serial == "C-77"
    assert json.loads(FolderPictures(tmp_path / "frames").head.calibration)["serial"] == "C-77"


def chunk_edges(path):
    """Places behind each record of a file."""
    raw = path.read_bytes()
    place, edges = 8, []
    while place + 9 <= len(raw) - 8:
        place += 9 + int.from_bytes(raw[place + 1 : place + 9], "little")
        edges.append(place)
    return raw, edges


def recovered(raw, tmp_path):
    path = tmp_path / "cut.mcap"
    path.write_bytes(raw)
    try:
        reader = McapPictures(path)
        found = list(reader.pictures())
    except RecordingError:
        return [], "no picture"
    return found, reader.damage


def test_a_file_that_is_cut_anywhere_gives_every_picture_before_the_cut(tmp_path, oni):
    convert(oni, tmp_path / "a.mcap")
    raw, edges = chunk_edges(tmp_path / "a.mcap")
    whole = list(McapPictures(tmp_path / "a.mcap").pictures())
    # A chunk is one message; its record ends where the next begins.
    ends = [edge for edge, begin in zip(edges, [8, *edges], strict=False) if raw[begin] == 0x06]
    random_cuts = np.random.default_rng(5).integers(0, len(raw), 200).tolist()
    counts = {1: 0}
    for cut in (*edges, *random_cuts):
        found, damage = recovered(raw[:cut], tmp_path)
        complete = sum(end <= cut for end in ends)
        has_depth = any(one.depth_mm is not None for one in whole[:complete])
        assert len(found) == (complete if has_depth else 0), cut
        for mine, theirs in zip(found, whole, strict=False):
            assert (mine.timestamp_us, mine.frame_id, mine.jpeg) == (theirs.timestamp_us, theirs.frame_id, theirs.jpeg)
        assert damage is not None or cut == len(raw) or len(found) == len(whole), cut
        counts[1] += len(found) > 0
    assert counts[1] > 150


def test_a_changed_byte_gives_no_wrong_picture(tmp_path, oni):
    convert(oni, tmp_path / "a.mcap")
    raw = bytearray((tmp_path / "a.mcap").read_bytes())
    whole = {one.timestamp_us: one for one in McapPictures(tmp_path / "a.mcap").pictures()}
    for place in np.random.default_rng(6).integers(8, len(raw) - 8, 60).tolist():
        changed = bytearray(raw)
        changed[place] ^= 0x41
        found, _ = recovered(bytes(changed), tmp_path)
        for one in found:
            theirs = whole[one.timestamp_us]
            assert one.jpeg == theirs.jpeg
            if one.depth_mm is not None:
                np.testing.assert_array_equal(one.depth_mm, theirs.depth_mm)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_large_compressed_chunks_of_others_are_read(tmp_path, oni, compression):
    convert(oni, tmp_path / "a.mcap")
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start(profile="ros2")
        schema = writer.register_schema("sensor_msgs/msg/CompressedImage", "ros2msg", b"")
        channel = writer.register_channel("/camera/depth/image_rect_raw/compressedDepth", "cdr", schema)
        with (tmp_path / "a.mcap").open("rb") as given:
            for _, found, message in make_reader(given).iter_messages(topics=[DEPTH]):
                writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
                assert found.topic == DEPTH
        writer.finish()
    reader = McapPictures(path)
    assert (reader.head.serial, reader.head.time_base, reader.head.color_size) == ("unknown", "unknown", None)
    assert reader.head.fps == pytest.approx(29.97, abs=0.01)
    same(content(reader)[0], content(OniPictures(oni))[0])


def test_of_a_source_that_is_cut_off_what_comes_before_is_converted(tmp_path, oni):
    raw = oni.read_bytes()
    oni.write_bytes(raw[: len(raw) // 2])
    done = convert(oni, tmp_path / "a.mcap")
    assert 0 < done.depth < FRAMES
    assert done.damage is not None


@pytest.mark.parametrize(
    ("source", "target", "error", "said"),
    [
        ("rec.oni", "rec.oni", InvalidValueError, "another than the source"),
        ("rec.oni", "a.bag", InvalidValueError, "folder of PNG"),
        ("rec.txt", "a.mcap", InvalidValueError, "folder of PNG"),
        ("absent.oni", "a.mcap", RecordingError, "cannot be opened"),
        ("absent.mcap", "a.oni", RecordingError, "cannot be opened"),
        ("text.mcap", "a.oni", RecordingError, "no depth picture"),
        ("empty", "a.oni", RecordingError, "depth/"),
        ("rec.oni", "empty", RecordingError, "exists already"),
    ],
)
def test_what_cannot_be_converted_is_refused_and_nothing_is_left(tmp_path, oni, source, target, error, said):
    (tmp_path / "text.mcap").write_text("no recording")
    (tmp_path / "empty").mkdir()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    with pytest.raises(error, match=said):
        convert(tmp_path / source, tmp_path / target)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("depth/frame.png", b"", "NUMBER_MICROSECONDS.png"),
        ("depth/1_5.png", b"no png", "16 bits"),
        ("depth/1_5.png", cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes(), "16 bits"),
        (HEAD_FILE, b"{", "no JSON"),
        (HEAD_FILE, b'{"schema": "other/1"}', "tidegate.pictures/1"),
    ],
)
def test_a_folder_of_another_form_is_refused_by_the_file_s_name(tmp_path, name, data, said):
    folder = tmp_path / "frames"
    (folder / "depth").mkdir(parents=True)
    (folder / "depth/000_10.png").write_bytes(cv2.imencode(".png", depth_of(1))[1].tobytes())
    (folder / name).write_bytes(data)
    with pytest.raises(RecordingError, match=said):
        FolderPictures(folder)


@pytest.mark.parametrize(("times", "shape"), [((5, 40_000), SIZE), ((5, 40_000), (32, 24))])
def test_pictures_without_numbers_are_numbered_and_those_that_do_not_fit_are_refused(tmp_path, times, shape):
    path = tmp_path / "other.mcap"
    with McapPictureWriter(path, RecordingHead(depth_size=SIZE, color_size=None)) as writer:
        for at, size in zip(times, (SIZE, shape), strict=True):
            depth = np.full(size[::-1], 800, np.uint16)
            writer.write(Picture(timestamp_us=at, frame_id=0, depth_mm=depth))
    if shape == SIZE:
        assert convert(path, tmp_path / "b.oni").depth == 2
        assert [one[1] for one in content(OniPictures(tmp_path / "b.oni"))[0]] == [1, 2]
    else:
        with pytest.raises(RecordingError, match=r"other\.mcap: "):
            convert(path, tmp_path / "b.oni")
        assert not (tmp_path / "b.oni").exists()


@pytest.mark.parametrize("target", ["b.oni", "frames"])
def test_colour_that_begins_late_is_refused_and_not_dropped(tmp_path, monkeypatch, target):
    monkeypatch.setattr(mcap_file, "MOST", 3)
    path = tmp_path / "late.mcap"
    with McapPictureWriter(path, RecordingHead(depth_size=SIZE, color_size=SIZE)) as writer:
        for number in range(6):
            writer.write(Picture(timestamp_us=1 + number, frame_id=number, depth_mm=depth_of(number)))
        writer.write(Picture(timestamp_us=9, frame_id=0, rgb=color_of(0)))
    with pytest.raises(RecordingError, match="colour begins later"):
        convert(path, tmp_path / target)
    assert [one.name for one in tmp_path.iterdir()] == ["late.mcap"]


def test_a_message_that_is_none_is_refused_by_its_topic(tmp_path):
    path = tmp_path / "bad.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(DEPTH, "cdr", writer.register_schema("x", "ros2msg", b""))
        writer.add_message(channel, 0, b"\x00\x01\x00\x00\xff\xff", 0)
        writer.finish()
    with pytest.raises(RecordingError, match="CompressedImage"):
        McapPictures(path)


def test_an_error_while_it_is_written_leaves_no_file(tmp_path):
    head = RecordingHead(depth_size=SIZE, color_size=None)

    def fail():
        with McapPictureWriter(tmp_path / "a.mcap", head) as writer:
            writer.write(Picture(timestamp_us=1, frame_id=1, depth_mm=depth_of(1)))
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_without_the_package_the_refusal_names_what_installs_it(tmp_path, oni, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mcap", None)
    with pytest.raises(InvalidValueError, match=r"tidegate\[mcap\]"):
        convert(oni, tmp_path / "a.mcap")
    assert mcap_file.LARGEST_RECORD > 0
    assert not (tmp_path / "a.mcap").exists()
