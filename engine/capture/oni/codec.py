"""The pictures inside an ``.oni`` file: ``16zT`` depth to bytes, and JPEG colour to bytes and back.

``16zT`` replaces each depth by its rank among the depths that occur (the embedded table, in front) and writes the steps
between neighbours, previous minus current, in nibbles::

    u16 n, n x u16 table, u16 first rank, then per byte
    0x00..0xdf   two steps, each nibble minus 6; low nibble d: only one step; low nibble f: one step, then a long one
    0xe0..0xfe   that many minus 0xe0 pairs of zero steps
    0xff         a long step
    long step    one byte from 0x80: minus 192; otherwise two bytes: the rank itself, high byte first

Both directions are vectorised. Thirty pictures of 307,200 pixels come a second, and a recording is read ten times as
fast as that. Decoding: where it is built, a
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

from engine.core.compiled import FramePath
from engine.core.errors import RecordingError
from engine.core.frames import ColorImage, DepthImage

_Bytes = npt.NDArray[np.uint8]
_Steps = npt.NDArray[np.int16]
_Indices = npt.NDArray[np.intp]

MAX_RANKS = 0x8000
_PAIRS_A_RUN = 15
_Words = npt.NDArray[np.uint16]
_Ranks = npt.NDArray[np.unsignedinteger]
_Bools = npt.NDArray[np.bool_]
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


def encode_16zt(depth_mm: DepthImage) -> bytes:
    """Encode one depth picture, shape (rows, columns), to the bytes the runtime's own recorder writes.

    With one exception: the runtime swaps the last single step with the run of zero steps before it, and so loses the
    last pixels of such a picture. Here they are kept.

    Raises
    ------
    ValueError
        The picture holds more than 32,768 different depths, which this codec cannot represent.
    """
    picture = np.ascontiguousarray(depth_mm, dtype=np.uint16)
    occurs = np.zeros(0x10000, np.bool_)
    occurs[picture.reshape(-1)] = True
    table = np.flatnonzero(occurs).astype("<u2")
    if table.size > MAX_RANKS:
        msg = f"{table.size} different depths in one picture; 16zT can hold {MAX_RANKS}"
        raise ValueError(msg)
    rank_of = (np.cumsum(occurs, dtype=np.int32) - 1).astype(np.int16)
    rank = cv2.LUT(picture, rank_of.reshape(1, -1)).reshape(-1).astype(np.int16, copy=False)
    head = np.array([table.size], "<u2").tobytes() + table.tobytes() + rank[:1].astype("<u2").tobytes()
    return head + _encode_steps(rank)


def _encode_steps(rank: _Steps) -> bytes:
    step = rank[:-1] - rank[1:]  # at most 32,767 either way: no overflow
    long = np.flatnonzero(np.abs(step) > 6)
    nibble = (step + 6).astype(np.uint8)
    low = np.append(nibble[1:], np.uint8(0x0D))
    low[long[long > 0] - 1] = 0x0F
    code: _Bytes = (nibble << np.uint8(4)) | low
    code[long] = 0xFF
    # Steps pair up anew after every long one; a long one met halfway stands in the low nibble of the one before. So n
    # short steps and the long one behind them make n // 2 + 1 codes, the last of which carries the long one.
    short = np.diff(long, prepend=-1) - 1
    carrier = np.cumsum(short // 2 + 1) - 1
    code, place = _shorten_runs(code[_leads(long, step.size)])
    return _insert_arguments(code, place[carrier], step[long], rank[1:][long])


def _leads(long: _Indices, size: int) -> _Indices:
    """Return the steps that begin a code: every other one, counted from the step behind the last long one."""
    begins = np.concatenate([[0], long + 1])
    parity = np.repeat((begins & 1).astype(np.uint8), np.diff(begins, append=size))
    parity[1::2] ^= 1
    return np.flatnonzero(parity == 0)


def _shorten_runs(code: _Bytes) -> tuple[_Bytes, _Indices]:
    """Write runs of pairs of zero steps as counts; return the bytes, and where each code's byte went."""
    is_pair = np.concatenate([[False], code == 0x66, [False]])
    edges = np.flatnonzero(is_pair[1:] != is_pair[:-1])
    begin, length = edges[::2], edges[1::2] - edges[::2]
    is_kept = ~is_pair[1:-1]
    last = begin + length - 1
    is_kept[last] = True
    code[last] = 0xE1 + (length - 1) % _PAIRS_A_RUN
    full = length // _PAIRS_A_RUN
    nth = np.arange(int(full.sum())) - np.repeat(np.cumsum(full) - full, full)
    full_at = np.repeat(begin, full) + (nth + 1) * _PAIRS_A_RUN - 1
    is_kept[full_at] = True
    code[full_at] = 0xE0 + _PAIRS_A_RUN
    return code[np.flatnonzero(is_kept)], np.cumsum(is_kept, dtype=np.intp) - 1


def _insert_arguments(code: _Bytes, carrier: _Indices, step: _Steps, rank: _Steps) -> bytes:
    """Put the long steps' bytes behind the codes that announce them."""
    is_whole = np.abs(step) > 63
    behind = np.ones(code.size + 1, np.intp)
    behind[carrier + 1] += 1 + is_whole
    behind[0] = 0
    place = np.cumsum(behind)
    stream = np.zeros(int(place[-1]), np.uint8)
    stream[place[:-1]] = code
    argument = place[carrier] + 1
    stream[argument] = np.where(is_whole, rank >> 8, step + 192).astype(np.uint8)
    stream[argument[is_whole] + 1] = rank[is_whole].astype(np.uint8)
    return stream.tobytes()


def encode_jpeg(rgb: ColorImage, quality: int) -> bytes:
    """Encode one colour picture, RGB, shape (rows, columns, 3)."""
    is_done, buffer = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not is_done:
        msg = f"no JPEG can be made of a picture of shape {rgb.shape}"
        raise ValueError(msg)
    return buffer.tobytes()


def decode_jpeg(payload: bytes | memoryview, shape: tuple[int, int]) -> ColorImage:
    """Decode one colour picture, RGB, of ``shape`` (rows, columns).

    Raises
    ------
    RecordingError
        These bytes are no such picture.
    """
    if _jpeg_size(payload) != shape:
        msg = f"colour picture is no JPEG of {shape[1]}x{shape[0]}"
        raise RecordingError(msg)
    try:
        picture = cv2.imdecode(np.frombuffer(payload, np.uint8), cv2.IMREAD_COLOR_RGB)
    except cv2.error as error:
        msg = "colour picture is a damaged JPEG"
        raise RecordingError(msg) from error
    if picture is None or picture.shape != (*shape, 3):
        msg = "colour picture is a damaged JPEG"
        raise RecordingError(msg)
    return np.asarray(picture, dtype=np.uint8)


def _jpeg_size(payload: bytes | memoryview) -> tuple[int, int] | None:
    """Read rows and columns from the head, so that a wrong head never costs memory."""
    if bytes(payload[:2]) != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(payload) and payload[at] == 0xFF:
        marker, length = payload[at + 1], int.from_bytes(payload[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            return int.from_bytes(payload[at + 5 : at + 7], "big"), int.from_bytes(payload[at + 7 : at + 9], "big")
        at += 2 + length
    return None


def decode_16zt(payload: bytes | memoryview, shape: tuple[int, int]) -> DepthImage:
    """Decode one depth picture of ``shape`` (rows, columns), in the unit it was recorded in.

    Raises
    ------
    RecordingError
        These bytes are no such picture.
    """
    compiled = FramePath.kernels
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
