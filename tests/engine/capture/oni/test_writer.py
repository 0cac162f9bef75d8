import numpy as np
import pytest

from engine.capture.oni.codec import encode_16zt
from engine.capture.oni.reader import OniReader, describe
from engine.capture.oni.records import CAMERA_MAGIC
from engine.capture.oni.writer import OniWriter
from tests.support.capture.oni_recordings import depth_picture, write_recording


def test_the_same_pictures_give_the_same_bytes(tmp_path):
    first = write_recording(tmp_path / "a.oni").read_bytes()
    assert write_recording(tmp_path / "b.oni").read_bytes() == first


def test_nothing_is_left_behind_when_writing_fails(tmp_path):
    path = tmp_path / "a.oni"
    path.write_bytes(b"an older recording")
    with pytest.raises(RuntimeError), OniWriter(path, depth_size=(64, 48), color_size=None) as writer:  # noqa: PT012
        writer.write_depth(0, depth_picture(0))
        raise RuntimeError
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("a.oni", b"an older recording")]


def test_the_recording_has_its_name_only_when_it_is_whole(tmp_path):
    writer = OniWriter(tmp_path / "a.oni", depth_size=(64, 48), color_size=None)
    writer.write_depth(0, depth_picture(0))
    assert not (tmp_path / "a.oni").exists()
    writer.close()
    writer.close()
    assert [file.name for file in tmp_path.iterdir()] == ["a.oni"]


@pytest.mark.parametrize(
    ("serial", "found"), [("A1", "A1"), ("", ""), ("ü" * 64, "ü" * 64), ("x" * 129, ""), ("a\nb", ""), ("\ud800", "")]
)
def test_the_camera_is_in_the_file_where_it_has_a_usable_number(tmp_path, serial, found):
    described = describe(write_recording(tmp_path / "a.oni", serial=serial))
    assert (described.serial, described.damage) == (found, None)


@pytest.mark.parametrize("tail", [b"", b"\x00\x00", b"a\nb\x03\x00", b"\xff\x01\x00", b"x" * 200 + b"\xff\xff"])
def test_an_end_that_names_no_camera_is_none(tmp_path, tail):
    path = write_recording(tmp_path / "a.oni")
    path.write_bytes(path.read_bytes() + tail + CAMERA_MAGIC)
    assert (describe(path).serial, describe(path).damage) == ("", None)


def test_a_payload_coded_elsewhere_is_written_as_it_is(tmp_path):
    with OniWriter(tmp_path / "a.oni", depth_size=(64, 48), color_size=None) as writer:
        writer.write_depth(0, depth_picture(0))
    with OniWriter(tmp_path / "b.oni", depth_size=(64, 48), color_size=None) as writer:
        writer.write_depth_payload(0, encode_16zt(depth_picture(0)))
    assert (tmp_path / "a.oni").read_bytes() == (tmp_path / "b.oni").read_bytes()


@pytest.mark.parametrize(
    "picture", [np.zeros((64, 48), np.uint16), np.zeros((48, 64), np.float32)], ids=["turned", "float"]
)
def test_a_picture_of_another_shape_or_type_is_refused(tmp_path, picture):
    with OniWriter(tmp_path / "a.oni", depth_size=(64, 48)) as writer, pytest.raises(ValueError, match="64x48 uint16"):
        writer.write_depth(0, picture)


def test_a_frame_number_cannot_go_back(tmp_path):
    with OniWriter(tmp_path / "a.oni", depth_size=(64, 48)) as writer:
        writer.write_depth(0, depth_picture(0), frame_id=5)
        with pytest.raises(ValueError, match="cannot follow frame 5"):
            writer.write_depth(1, depth_picture(0), frame_id=5)


@pytest.mark.parametrize("depth_codec", ["16zT", "NONE"])
@pytest.mark.parametrize("color_codec", ["JPEG", "NONE"])
def test_every_codec_is_read_back(tmp_path, depth_codec, color_codec):
    path = write_recording(tmp_path / "a.oni", frames=3, depth_codec=depth_codec, color_codec=color_codec)
    with OniReader(path) as reader:
        frames = list(reader.frames())
    depths = [frame.decode_depth() for frame in frames if frame.is_depth]
    assert all(np.array_equal(depth, depth_picture(index)) for index, depth in enumerate(depths))
    assert [frame.decode_color().shape for frame in frames if not frame.is_depth] == [(48, 64, 3)] * 3
