"""Files that are cut, flipped, empty or something else: one clear line, what was readable kept, no hang, no memory."""

import struct
import tracemalloc

import numpy as np
import pytest

from engine.capture.oni.reader import OniReader, describe
from engine.capture.oni.records import read_file_header, walk_records
from engine.core.errors import RecordingError
from tests.support.capture.oni_recordings import write_recording

pytestmark = pytest.mark.slow

FRAMES = 6


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return write_recording(tmp_path_factory.mktemp("whole") / "whole.oni", frames=FRAMES)


@pytest.fixture(scope="module")
def records(whole):
    """Where each record begins, and whether it is a frame."""
    with whole.open("rb") as file:
        walked = list(walk_records(file, read_file_header(file)))
    return [(record.at, record.payload_at + record.payload_bytes, record.type.name == "NEW_DATA") for record in walked]


def read_until_damage(path):
    """Decode everything; return how many frames came and the error's line, None if there was none."""
    count, words = 0, None
    try:
        with OniReader(path) as reader:
            for frame in reader.frames():
                frame.decode_depth() if frame.is_depth else frame.decode_color()
                count += 1
    except RecordingError as error:
        words = str(error)
    assert words is None or (words and "\n" not in words)
    return count, words


def test_a_cut_at_any_record_keeps_the_frames_before_it(whole, records, tmp_path):
    content = whole.read_bytes()
    path = tmp_path / "cut.oni"
    for at, _, _ in [*records, (records[-1][1], 0, False)]:
        path.write_bytes(content[:at])
        before = sum(is_frame and end <= at for _, end, is_frame in records)
        count, words = read_until_damage(path)
        assert count == before
        assert "cut" in words
        if at > records[0][1]:
            described = describe(path)
            assert described.damage == words
            assert described.depth.frames + (described.color.frames if described.color else 0) == before


def test_a_cut_at_any_byte_keeps_the_frames_before_it(whole, records, tmp_path):
    content = whole.read_bytes()
    path = tmp_path / "cut.oni"
    rng = np.random.default_rng(3)
    for at in [1, 3, 4, 23, 24, 25, *rng.integers(1, records[-1][1], 300).tolist()]:
        path.write_bytes(content[:at])
        count, words = read_until_damage(path)
        assert count == sum(is_frame and end <= at for _, end, is_frame in records)
        assert words is not None
        if at > records[0][1]:
            assert describe(path).damage == words


def test_a_record_without_its_mark_is_damage(whole, records, tmp_path):
    content = bytearray(whole.read_bytes())
    at = [at for at, _, is_frame in records if is_frame][3]
    content[at] ^= 1
    path = tmp_path / "mark.oni"
    path.write_bytes(content)
    assert read_until_damage(path) == (3, f"mark.oni: damaged at byte {at}: no record begins there")


def test_thousands_of_flipped_bits_give_frames_or_one_line(whole, tmp_path):
    content = whole.read_bytes()
    path = tmp_path / "flipped.oni"
    rng = np.random.default_rng(4)
    refused = 0
    for _ in range(2000):
        flipped = bytearray(content)
        for at in rng.integers(0, len(content), rng.integers(1, 4)):
            flipped[at] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        _, words = read_until_damage(path)
        refused += words is not None
    assert refused > 300


def test_every_flipped_bit_of_the_structure_is_survived(whole, records, tmp_path):
    content = whole.read_bytes()
    path = tmp_path / "flipped.oni"
    heads = [at + offset for at, _, _ in records[::3] for offset in range(40)]
    for at in [*range(24), *heads]:
        flipped = bytearray(content)
        flipped[at] ^= 1 << (at % 8)
        path.write_bytes(flipped)
        count, _ = read_until_damage(path)
        assert count <= 2 * FRAMES


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"NI10\x01\x00", "cut within its header, at byte 6"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "a PNG picture"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 5\n", "a Git LFS pointer"),
        (b"frame,depth\n1,850\n" * 9, "a text"),
        (bytes(4096), "it begins with 00 00 00 00"),
        (b"NI10\x02\x00" + bytes(40), "of format version 2.0.0.0"),
        (b"NI10\x01\x00\x00\x00\x03" + bytes(40), "of format version 1.0.0.3"),
    ],
    ids=["empty", "stub", "png", "lfs", "text", "zeros", "newer", "too old"],
)
def test_what_is_no_recording_is_named(tmp_path, content, words):
    path = tmp_path / "foreign.oni"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=f"foreign.oni: .*{words}"):
        describe(path)


@pytest.mark.parametrize("name", ["missing.oni", "."])
def test_what_cannot_be_opened_is_one_line_too(tmp_path, name):
    with pytest.raises(RecordingError, match="cannot be opened"):
        describe(tmp_path / name)


def test_a_name_with_a_line_break_still_gives_one_line(tmp_path):
    path = tmp_path / "a\nb.oni"
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match=r"^a\?b.oni: empty"):
        describe(path)


@pytest.mark.parametrize("claim", ["fields", "payload", "property", "frames"])
def test_a_claim_of_four_gigabytes_costs_no_memory(whole, records, tmp_path, claim):
    content = bytearray(whole.read_bytes())
    frame_at = next(at for at, _, is_frame in records if is_frame)
    offset = {"fields": 12, "payload": 16, "property": 28, "frames": 36}[claim]
    struct.pack_into("<I", content, (records[1][0] if claim == "property" else frame_at) + offset, 2**32 - 1)
    path = tmp_path / "huge.oni"
    path.write_bytes(content)
    tracemalloc.start()
    _, words = read_until_damage(path)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert words is not None
    assert peak_bytes < 4_000_000


def test_a_long_recording_is_streamed_not_loaded(tmp_path):
    path = write_recording(tmp_path / "long.oni", frames=60, depth_codec="NONE", color_codec="NONE", size_px=(160, 120))
    tracemalloc.start()
    count, _ = read_until_damage(path)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 120
    assert peak_bytes < path.stat().st_size / 4


def test_a_check_finds_the_picture_that_does_not_decode(whole, records, tmp_path):
    content = bytearray(whole.read_bytes())
    _, end, _ = [record for record in records if record[2]][4]  # depth frame 3
    content[end - 500 : end] = b"\xff" * 500
    path = tmp_path / "spoiled.oni"
    path.write_bytes(content)
    assert describe(path).damage is None
    checked = describe(path, is_checked=True)
    assert checked.damage.startswith("spoiled.oni: depth frame 3: depth picture")
    assert (checked.depth.frames, checked.color.frames) == (2, 2)
