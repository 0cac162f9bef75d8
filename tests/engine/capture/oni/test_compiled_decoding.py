"""Both decoders give the same picture, or the same error."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.capture.oni.codec import decode_16zt, encode_16zt
from engine.core import compiled
from engine.core.errors import RecordingError
from tests.support.capture.codec_oracle import decode_slowly
from tests.support.capture.oni_recordings import depth_picture

SHAPE = (6, 10)


def outcome(payload, shape=SHAPE):
    try:
        return decode_16zt(payload, shape).tolist()
    except RecordingError as error:
        return str(error)


def both(payload, shape=SHAPE):
    with compiled.numpy_forms():
        expected = outcome(payload, shape)
    return outcome(payload, shape), expected


@settings(max_examples=400, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=4), st.floats(0, 1.2)
)
def test_damaged_bytes_have_the_same_outcome(seed, changes, kept):
    rng = np.random.default_rng(seed)
    payload = bytearray(encode_16zt(rng.integers(0, rng.choice([1, 3, 30, 300, 20_000]), SHAPE).astype(np.uint16)))
    for where, value in changes:
        payload[int(where * (len(payload) - 1))] = value
    found, expected = both(bytes(payload[: max(1, int(kept * len(payload)))]))
    assert found == expected


@settings(max_examples=300, deadline=None)
@given(st.lists(st.integers(0, 255), max_size=90), st.integers(0, 300), st.integers(0, 70), st.integers(1, 150))
def test_any_codes_have_the_same_outcome(codes, ranks, first, pixels):
    head = np.array([ranks, *range(500, 500 + ranks), first], dtype="<u2").tobytes()
    found, expected = both(head + bytes(codes), (1, pixels))
    assert found == expected


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=40), st.sampled_from([(1, 1), (0, 0), (0, 5), (3, 2)]))
def test_no_bytes_and_no_pixels_have_the_same_outcome(payload, shape):
    found, expected = both(payload, shape)
    assert found == expected


@pytest.mark.parametrize("code", range(256))
def test_every_code_at_every_end_has_the_same_outcome(code):
    """Where what it stands for just fits, and where a pixel is missing or too many, near and far from the end."""
    for pixels in (1, 2, 3, 4, 59, 60, 61, 62, 63, 64, 65, 66, 67, 120, 130):
        for before in (b"", b"\x66", b"\xfe", b"\xfe\xfe"):
            for behind in (b"", b"\xc0", b"\x00\x03", b"\x66\x6d"):
                payload = np.array([5, 10, 20, 30, 40, 50, 2], dtype="<u2").tobytes() + before + bytes([code]) + behind
                found, expected = both(payload, (1, pixels))
                assert found == expected


def test_a_real_picture_is_read_from_any_bytes():
    picture = depth_picture(4)
    payload = encode_16zt(picture)
    assert np.array_equal(decode_16zt(payload, picture.shape), picture)
    assert np.array_equal(decode_16zt(memoryview(payload), picture.shape), picture)
    assert decode_slowly(payload, picture.size) == picture.reshape(-1).tolist()
