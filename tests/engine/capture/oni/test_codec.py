import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.capture.oni.codec import decode_16zt, decode_jpeg, encode_16zt, encode_jpeg
from engine.core.errors import RecordingError
from tests.support.capture.codec_oracle import count_pixels, decode_slowly
from tests.support.capture.oni_recordings import color_picture, depth_picture

pytestmark = pytest.mark.slow

SHAPE = (6, 10)


@st.composite
def pictures(draw):
    """Pictures by construction: runs, small steps, long steps, whole ranks, in any order."""
    spread = draw(st.sampled_from([1, 3, 12, 40, 150, 65_535]))
    parts = draw(
        st.lists(st.tuples(st.integers(0, spread), st.integers(1, 70)), min_size=1, max_size=12).map(
            lambda runs: [value for value, length in runs for _ in range(length)]
        )
    )
    tail = draw(st.lists(st.integers(0, spread), max_size=40))
    values = parts + tail
    return np.array(values, np.uint16).reshape(1, -1)


@settings(max_examples=300, deadline=None)
@given(pictures())
def test_a_picture_comes_back_bit_for_bit(picture):
    assert np.array_equal(decode_16zt(encode_16zt(picture), picture.shape), picture)


@settings(max_examples=150, deadline=None)
@given(pictures())
def test_what_we_write_means_the_same_read_pixel_by_pixel(picture):
    assert decode_slowly(encode_16zt(picture), picture.size) == picture.reshape(-1).tolist()


@settings(max_examples=500, deadline=None)
@given(st.integers(0, 2**32), st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=4), st.floats(0, 1.2))
def test_damaged_bytes_give_what_the_slow_reader_gives_or_one_error(seed, changes, kept):
    rng = np.random.default_rng(seed)
    payload = bytearray(encode_16zt(rng.integers(0, rng.choice([3, 30, 300]), SHAPE).astype(np.uint16)))
    for where, value in changes:
        payload[int(where * (len(payload) - 1))] = value
    payload = bytes(payload[: max(1, int(kept * len(payload)))])
    expected = decode_slowly(payload, SHAPE[0] * SHAPE[1])
    if expected is None:
        with pytest.raises(RecordingError):
            decode_16zt(payload, SHAPE)
    else:
        assert decode_16zt(payload, SHAPE).reshape(-1).tolist() == expected


LOOKS_LIKE_A_HEAD = st.sampled_from([0x0F, 0x7F, 0xDF, 0xFF])


@st.composite
def streams(draw):
    """Streams by construction: every kind of code, with arguments that look like codes of their own."""
    argument = st.one_of(LOOKS_LIKE_A_HEAD, st.integers(0, 255))
    head = st.sampled_from([0xFF, 0x6F, 0x0F, 0xCF])
    step = st.tuples(head, argument.map(lambda byte: byte | 0x80)).map(bytes)
    whole = st.tuples(head, st.sampled_from([0, 0, 0, 1, 0x0F, 0x7F]), argument).map(bytes)
    plain = st.one_of(st.sampled_from([0x66, 0x57, 0x75, 0x6D, 0x6E]), st.integers(0, 0xFE)).map(lambda c: bytes([c]))
    return b"".join(draw(st.lists(st.one_of(plain, step, whole), max_size=40)))


@settings(max_examples=300, deadline=None)
@given(streams(), st.sampled_from([1, 100, 191, 192, 193, 255, 256, 300, 4000, 40_000, 65_535]), st.floats(0, 0.999))
def test_every_stream_gives_what_the_slow_reader_gives_however_long_its_table(stream, ranks, first):
    payload = _payload(np.arange(7, 7 + ranks).astype("<u2"), stream, first_rank=int(first * ranks))
    pixels = count_pixels(stream)
    expected = decode_slowly(payload, pixels)
    if expected is None:
        with pytest.raises(RecordingError):
            decode_16zt(payload, (1, pixels))
    else:
        assert decode_16zt(payload, (1, pixels)).reshape(-1).tolist() == expected


UP_64, DOWN_63, DOWN_2, UP_1 = b"\xff\x80", b"\xff\xff", b"\x8d", b"\x5d"


@pytest.mark.parametrize("ranks", [3, 191, 192, 193, 256, 257])
@pytest.mark.parametrize(
    ("stream", "is_upwards"),
    [
        (UP_64 + b"\xe3", True),
        (UP_64 + DOWN_63 + DOWN_2 + b"\xe2", True),
        (DOWN_63 + b"\xe3", False),
        (DOWN_63 + UP_64 + UP_1 + b"\xe2", False),
    ],
    ids=["behind it", "behind it and back", "before it", "before it and back"],
)
def test_leaving_the_table_is_seen_wherever_the_walk_goes_from_there(ranks, stream, is_upwards):
    payload = _payload(np.arange(ranks, dtype="<u2"), stream, first_rank=ranks - 1 if is_upwards else 0)
    with pytest.raises(RecordingError, match=f"a depth behind the {ranks} of its table"):
        decode_16zt(payload, (2, 4))
    inside = _payload(np.arange(ranks + 128, dtype="<u2"), stream, first_rank=64)
    assert decode_16zt(inside, (2, 4)).reshape(-1).tolist() == decode_slowly(inside, 8)


def test_a_picture_of_many_depths_comes_back_in_full_size():
    picture = depth_picture(3, (640, 480)) + (np.arange(480, dtype=np.uint16) * 9)[:, None]
    assert np.unique(picture).size > 1000
    assert np.array_equal(decode_16zt(encode_16zt(picture), (480, 640)), picture)


@given(st.binary(max_size=400))
def test_any_bytes_give_a_picture_or_one_error(payload):
    expected = decode_slowly(payload, SHAPE[0] * SHAPE[1])
    try:
        decoded = decode_16zt(payload, SHAPE).reshape(-1).tolist()
    except RecordingError:
        decoded = None
    assert decoded == expected


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (b"\x57\xe2\x6d", [500, 501, 500, 500, 500, 500, 500, 500]),  # two steps, two pairs of none, one step alone
        (b"\x6f\xc5\xe2\x6d", [500, 500, 495, 495, 495, 495, 495, 495]),  # a long step in the low nibble
        (b"\xff\x00\x07\xe3", [500, 7, 7, 7, 7, 7, 7, 7]),  # a rank given whole
        (b"\xff\xbf\xe3", [500, 501, 501, 501, 501, 501, 501, 501]),  # a long step that is small
        (b"\x6e\x4e\xe1\x6d", [500, 500, 492, 494, 486, 486, 486, 486]),  # low nibble e is a step of 8
    ],
)
def test_each_code_means_what_the_runtime_reads(stream, expected):
    payload = _payload(np.arange(1000, dtype="<u2"), stream, first_rank=500)
    assert decode_16zt(payload, (2, 4)).reshape(-1).tolist() == expected


def _payload(table, stream, first_rank=0):
    return len(table).to_bytes(2, "little") + table.tobytes() + first_rank.to_bytes(2, "little") + stream


def test_the_first_depth_behind_the_table_is_refused():
    with pytest.raises(RecordingError, match="a depth behind the 3 of its table"):
        decode_16zt(_payload(np.arange(3, dtype="<u2"), b"\xe3\x6d", first_rank=3), (2, 4))


def test_bytes_of_a_whole_rank_that_look_like_long_steps_are_none():
    payload = _payload(np.arange(4000, dtype="<u2"), b"\xff\x0f\x0f\xe3", first_rank=1)
    assert decode_16zt(payload, (2, 4)).reshape(-1).tolist() == [1, *[0x0F0F] * 7]


def test_a_stream_longer_than_any_picture_needs_is_refused_unread():
    with pytest.raises(RecordingError, match="too long: 181 bytes for 60 pixels"):
        decode_16zt(_payload(np.arange(3, dtype="<u2"), b"\xe0" * 181), SHAPE)


@pytest.mark.parametrize(("ranks", "end"), [(64, b"\xff\xff"), (65, b"\xff\x00\x00")])
def test_a_step_of_63_takes_one_byte_and_one_of_64_two(ranks, end):
    picture = np.append(np.arange(ranks), 0).astype(np.uint16).reshape(1, -1)
    assert encode_16zt(picture).endswith(end if ranks % 2 else end[1:])


def test_long_runs_are_counted_by_fifteens_as_the_runtime_writes_them():
    picture = np.full((1, 1 + 2 * 47), 800, np.uint16)
    assert encode_16zt(picture)[6:] == b"\xef\xef\xef\xe2"


def test_more_depths_than_the_codec_can_number_are_refused():
    with pytest.raises(ValueError, match="40000 different depths"):
        encode_16zt(np.arange(40_000, dtype=np.uint16).reshape(200, 200))


def test_a_stream_of_nothing_but_long_steps_is_refused_without_being_walked_for_ever():
    payload = _payload(np.arange(3, dtype="<u2"), b"\xff" * 3 * 307_200)
    with pytest.raises(RecordingError, match="pixels instead of 307200"):
        decode_16zt(payload, (480, 640))


def test_a_stream_that_claims_millions_of_pixels_costs_no_memory():
    with pytest.raises(RecordingError, match="pixels instead of 60"):
        decode_16zt(_payload(np.arange(9, dtype="<u2"), b"\xfe" * 150), SHAPE)


def test_a_full_size_picture_comes_back():
    picture = depth_picture(3, (640, 480))
    assert np.array_equal(decode_16zt(encode_16zt(picture), (480, 640)), picture)


def test_colour_is_rgb_on_both_ways():
    decoded = decode_jpeg(encode_jpeg(color_picture(40), 95), (48, 64))
    assert np.abs(decoded.astype(int) - color_picture(40)).mean() < 2.0


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xff\xd8", b"\xff\xd8\xff\xe0\x00\x00" * 9, b"hello there", encode_jpeg(color_picture(1), 90)[:200]],
    ids=["empty", "head only", "endless head", "text", "cut"],
)
def test_what_is_no_jpeg_gives_one_error(payload):
    with pytest.raises(RecordingError):
        decode_jpeg(payload, (48, 64))


def test_a_jpeg_that_claims_another_size_is_refused_before_it_is_decoded():
    payload = encode_jpeg(np.zeros((8, 8, 3), np.uint8), 90)
    frame_at = payload.index(b"\xff\xc0")
    huge = payload[: frame_at + 5] + b"\xff\xff\xff\xff" + payload[frame_at + 9 :]
    with pytest.raises(RecordingError, match="no JPEG of 64x48"):
        decode_jpeg(huge, (48, 64))
