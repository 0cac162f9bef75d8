"""``16zT`` bytes to a depth picture; :mod:`engine.capture.oni.codec` describes the bytes.

Thirty pictures of 307,200 pixels come a second, and a recording is read ten times as fast as that. Where it is built, a
compiled loop decodes them (`engine.core.compiled`). The numpy form has no loop over bytes or pixels: each byte is
looked up, the pixels it stands for are counted and summed up to where its steps belong, and the steps are summed up to
ranks. OpenCV's integral image does the sums; numpy's cumsum takes five times as long.

Ranks wrap at 16 bit, as they do in the runtime. The bytes are untrusted: work and memory are bounded by the
picture's size.
"""

import math

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.compiled import kernels
from engine.core.errors import RecordingError
from engine.core.frames import DepthImage

_Bytes = npt.NDArray[np.uint8]
_Words = npt.NDArray[np.uint16]
_Ranks = npt.NDArray[np.unsignedinteger]
_Bools = npt.NDArray[np.bool_]
_Indices = npt.NDArray[np.intp]

_LONGEST_STEP = 64
_CODES = np.arange(256)
_LOW, _HIGH = _CODES & 15, _CODES >> 4
_IS_STEPS = _CODES < 0xE0
_HEAD = 0x80
"""Marks, beside the count of pixels, the bytes that announce a long step."""
_COUNT = np.where(_IS_STEPS, np.where(_LOW == 13, 1, 2), 2 * (_CODES - 0xE0))
_COUNT[0xFF] = 1
_SHAPE = (_COUNT + _HEAD * ((_CODES == 0xFF) | (_IS_STEPS & (_LOW == 15)))).astype(np.uint8)
# Steps are stored higher by the longest, so that none is negative.
_FIRST = (_LONGEST_STEP + np.where(_IS_STEPS, 6 - _HIGH, 0)).astype(np.uint8)
_SECOND = (_LONGEST_STEP + np.where(_IS_STEPS & (_LOW != 13) & (_LOW != 15), 6 - _LOW, 0)).astype(np.uint8)


def decode_16zt(payload: bytes | memoryview, shape: tuple[int, int]) -> DepthImage:
    """Decode one depth picture of ``shape`` (rows, columns), in the unit it was recorded in.

    Raises
    ------
    RecordingError
        These bytes are no such picture.
    """
    compiled = kernels()
    if compiled is not None and 0 not in shape:
        picture = np.empty(shape, dtype=np.uint16)
        if compiled.decode_16zt(payload, picture):
            return picture
    return _decode(payload, shape)  # names what is wrong with a damaged one


def _decode(payload: bytes | memoryview, shape: tuple[int, int]) -> DepthImage:
    """Decode with numpy."""
    pixels = shape[0] * shape[1]
    words = np.frombuffer(payload, dtype="<u2", count=len(payload) // 2)
    ranks = int(words[0]) if words.size else 0
    if words.size < ranks + 2:
        msg = f"depth picture is cut: {len(payload)} bytes cannot hold a table of {ranks} depths"
        raise RecordingError(msg)
    # Two zeros behind, so that looking at the two bytes after any byte is safe.
    codes = np.frombuffer(b"".join((payload, bytes(2))), dtype=np.uint8, offset=2 * ranks + 4)
    if codes.size - 2 > 3 * pixels:
        msg = f"depth picture is too long: {codes.size - 2} bytes for {pixels} pixels"
        raise RecordingError(msg)
    step, whole_at, whole_rank = _read_steps(codes, pixels)
    anchor_rank = np.concatenate([words[ranks + 1 : ranks + 2], whole_rank])
    # A byte is enough where the first step out of the table cannot come back in at its other end.
    rank_bits = 8 if ranks <= 256 - _LONGEST_STEP else 16
    # A few long rows instead of many short ones: numpy loops over rows.
    rank = _sum_up(step.reshape(math.gcd(shape[0], 16), -1), whole_at, anchor_rank, np.dtype(f"u{rank_bits // 8}"))
    if max(int(anchor_rank.max()), int(rank.max())) >= ranks:
        msg = f"depth picture is damaged: it uses a depth behind the {ranks} of its table"
        raise RecordingError(msg)
    table = np.zeros((1, 1 << rank_bits), np.uint16)
    table[0, :ranks] = words[1 : ranks + 1]
    return np.asarray(cv2.LUT(rank.reshape(shape), table), dtype=np.uint16)


def _read_steps(codes: _Bytes, pixels: int) -> tuple[_Bytes, _Indices, _Words]:
    """Return each pixel's step from the pixel before, and where ranks are given whole, and these.

    Steps are this pixel's rank minus the one before, plus the longest; where a rank is given whole there is none.
    """
    size = codes.size - 2
    form = _look_up(codes, _SHAPE)
    heads, is_whole = _find_heads(form, codes)
    if heads.size and heads[-1] + is_whole[-1] + 1 >= size:
        msg = "depth picture is cut within a step"
        raise RecordingError(msg)
    whole = heads.compress(is_whole)
    at = _place(form, heads, whole, pixels)
    step = _put_steps(codes, at, heads.compress(~is_whole), pixels)
    whole_at = at[whole] + 1 + (codes[whole] != 0xFF)
    whole_rank = (codes[whole + 1].astype(np.uint16) << 8) | codes[whole + 2]
    return step, whole_at, whole_rank


def _place(form: _Bytes, heads: _Indices, whole: _Indices, pixels: int) -> _Indices:
    """Return behind which pixel each byte's steps go."""
    count = form & np.uint8(_HEAD - 1)
    count[heads + 1] = 0
    count[whole + 2] = 0
    count[-2:] = 0
    end = cv2.integral(count.reshape(1, -1))[1]
    decoded = 1 + int(end[-1])
    if decoded != pixels:
        msg = f"depth picture is damaged: {decoded} pixels instead of {pixels}"
        raise RecordingError(msg)
    at: _Indices = end[:-1].astype(np.intp)
    return at


def _put_steps(codes: _Bytes, at: _Indices, long_heads: _Indices, pixels: int) -> _Bytes:
    first, second = _look_up(codes, _FIRST), _look_up(codes, _SECOND)
    long = np.negative(codes[long_heads + 1])  # at 8 bit: 192 minus the byte, plus the longest
    is_alone = codes[long_heads] == 0xFF
    first[long_heads.compress(is_alone)] = long.compress(is_alone)
    second[long_heads.compress(~is_alone)] = long.compress(~is_alone)
    step = np.full(pixels + 2, _LONGEST_STEP, np.uint8)
    # A byte that stands for no pixels, or for one, writes too far, and what comes behind it writes over that.
    step[2:][at] = second
    step[1:][at] = first
    return step[:pixels]


def _look_up(codes: _Bytes, table: _Bytes) -> _Bytes:
    return np.asarray(cv2.LUT(codes, table), dtype=np.uint8).reshape(-1)


def _find_heads(form: _Bytes, codes: _Bytes) -> tuple[_Indices, _Bools]:
    """Return where long steps begin, and whether each is a rank given whole, which takes two bytes more instead of one.

    A byte that belongs to one long step may look like the head of another.
    """
    heads = _where(form >= _HEAD)
    is_whole = codes[heads + 1] < 0x80
    reach = heads + 1 + is_whole
    is_near, is_near_two_back = np.zeros((2, heads.size), np.bool_)
    is_near[1:] = heads[1:] <= reach[:-1]
    is_near_two_back[2:] = heads[2:] <= reach[:-2]
    is_head = ~is_near
    is_argument = np.zeros(heads.size, np.bool_)
    is_argument[1:] = is_near[1:] & is_head[:-1]
    is_argument[2:] |= is_near_two_back[2:] & is_head[:-2]
    # Few are left in a real picture. Each hangs on the two before it, so they are settled in order.
    settled, two_back = bytearray(is_head), bytes(is_near_two_back)
    for i in np.flatnonzero(is_near & ~is_argument).tolist():
        settled[i] = not (settled[i - 1] or (two_back[i] and settled[i - 2]))
    is_head = np.frombuffer(settled, np.bool_)
    return heads.compress(is_head), is_whole.compress(is_head)


def _where(mask: _Bools) -> _Indices:
    """Return where ``mask`` is true; faster than `flatnonzero`, which wastes time where a tenth or less is true."""
    padded = np.ones(mask.size + mask.size // 8 + 1, np.bool_)
    padded[: mask.size] = mask
    found = np.flatnonzero(padded)
    return found[: found.size - (padded.size - mask.size)]


def _sum_up(step: _Bytes, whole_at: _Indices, anchor_rank: _Words, rank_type: np.dtype[np.unsignedinteger]) -> _Ranks:
    """Sum steps up to ranks; from the first pixel, and anew from each one whose rank is given whole."""
    rank = _walk(step, rank_type)
    walked = rank.reshape(-1)
    begin = np.concatenate([[0], whole_at, [walked.size]])
    offset = anchor_rank.astype(rank_type)
    offset[1:] -= walked[whole_at]
    walked += np.repeat(offset, begin[1:] - begin[:-1])
    return rank


def _walk(step: _Bytes, rank_type: np.dtype[np.unsignedinteger]) -> _Ranks:
    rows, columns = step.shape
    # Each entry sums up its own row up to there and all the rows above.
    total = cv2.integral(step).astype(rank_type)
    rank = total[1:, 1:] - total[:-1, 1:]
    rank += total[:-1, -1:] - (_LONGEST_STEP * columns * np.arange(rows)[:, None]).astype(rank_type)
    rank -= (_LONGEST_STEP * np.arange(1, columns + 1)).astype(rank_type)
    return rank
