"""The pictures inside an ``.oni`` file: ``16zT`` depth and JPEG colour, to bytes and back.

``16zT`` replaces each depth by its rank among the depths that occur (the embedded table, in front) and writes the steps
between neighbours, previous minus current, in nibbles::

    u16 n, n x u16 table, u16 first rank, then per byte
    0x00..0xdf   two steps, each nibble minus 6; low nibble d: only one step; low nibble f: one step, then a long one
    0xe0..0xfe   that many minus 0xe0 pairs of zero steps
    0xff         a long step
    long step    one byte from 0x80: minus 192; otherwise two bytes: the rank itself, high byte first

Both ways are vectorised: a frame has 307,200 pixels and thirty of them come a second. Ranks wrap at 16 bit, as they do
in the runtime. Bytes are hostile: whatever they hold, work and memory are bounded by the picture's size.
"""

import cv2
import numpy as np
import numpy.typing as npt

from engine.errors import RecordingError
from engine.frames import ColorImage, DepthImage

_Bytes = npt.NDArray[np.uint8]
_Words = npt.NDArray[np.uint16]
_Steps = npt.NDArray[np.int16]
_Indices = npt.NDArray[np.intp]

MAX_RANKS = 0x8000
_PAIRS_A_RUN = 15
_CODES = np.arange(256)
_LOW, _HIGH = _CODES & 15, _CODES >> 4
_IS_STEPS = _CODES < 0xE0
_IS_ESCAPE = (_CODES == 0xFF) | (_IS_STEPS & (_LOW == 15))
_PIXELS_OF = np.where(_IS_STEPS, np.where(_LOW == 13, 1, 2), 2 * (_CODES - 0xE0)).astype(np.uint8)
_PIXELS_OF[0xFF] = 1
_FIRST_STEP = np.where(_IS_STEPS, 6 - _HIGH, 0).astype(np.int16).view(np.uint16)
_SECOND_STEP = np.where(_IS_STEPS & (_LOW != 13) & (_LOW != 15), 6 - _LOW, 0).astype(np.int16).view(np.uint16)


def decode_16zt(payload: bytes | memoryview, shape: tuple[int, int]) -> DepthImage:
    """Decode one depth picture of ``shape`` (rows, columns), in the unit it was recorded in.

    Raises
    ------
    RecordingError
        These bytes are no such picture.
    """
    pixels = shape[0] * shape[1]
    words = np.frombuffer(payload, dtype="<u2", count=len(payload) // 2)
    ranks = int(words[0]) if words.size else 0
    if words.size < ranks + 2:
        msg = f"depth picture is cut: {len(payload)} bytes cannot hold a table of {ranks} depths"
        raise RecordingError(msg)
    codes = np.frombuffer(payload, dtype=np.uint8, offset=2 * ranks + 4)
    if codes.size > 3 * pixels:
        msg = f"depth picture is too long: {codes.size} bytes for {pixels} pixels"
        raise RecordingError(msg)
    rank = _decode_ranks(codes, int(words[ranks + 1]), pixels)
    highest = int(rank.max())
    if highest >= ranks:
        msg = f"depth picture is damaged: it uses depth number {highest} of {ranks}"
        raise RecordingError(msg)
    table = np.zeros((1, 0x10000), np.uint16)
    table[0, :ranks] = words[1 : ranks + 1]
    return np.asarray(cv2.LUT(rank.reshape(shape), table), dtype=np.uint16)


def _decode_ranks(codes: _Bytes, first_rank: int, pixels: int) -> _Words:
    padded = np.concatenate([codes, np.zeros(2, np.uint8)])
    escapes = _find_escapes(padded)
    is_long = padded[escapes + 1] < 0x80
    if escapes.size and escapes[-1] + is_long[-1] + 1 >= codes.size:
        msg = "depth picture is cut within a step"
        raise RecordingError(msg)
    count = _PIXELS_OF.take(codes, mode="clip")
    is_argument = np.zeros(codes.size, np.bool_)
    is_argument[escapes + 1] = True
    is_argument[escapes[is_long] + 2] = True
    count[is_argument] = 0
    end = np.cumsum(count, dtype=np.intp)
    decoded = 1 + (int(end[-1]) if end.size else 0)
    if decoded != pixels:
        msg = f"depth picture is damaged: {decoded} pixels instead of {pixels}"
        raise RecordingError(msg)
    step = np.zeros(pixels + 1, np.uint16)
    step[0] = first_rank
    before = end - count
    pairs = np.flatnonzero((codes < 0xE0) & ~is_argument)
    _place_short_steps(step, codes[pairs], before[pairs] + 1)
    _place_long_steps(step, padded, escapes, before[escapes] + 1 + (codes[escapes] != 0xFF))
    return np.cumsum(step[:pixels], dtype=np.uint16)


def _find_escapes(padded: _Bytes) -> _Indices:
    """Return where long steps begin; a byte that belongs to one long step may look like the head of another."""
    heads = np.flatnonzero(_IS_ESCAPE.take(padded[:-2], mode="clip"))
    if not heads.size:
        return heads
    reach = heads + 1 + (padded[heads + 1] < 0x80)
    doubtful = 1 + np.flatnonzero(heads[1:] <= reach[:-1])
    is_reached_twice = (doubtful >= 2) & (heads[doubtful] <= reach[np.maximum(doubtful - 2, 0)])
    # Few in a real picture. A doubt hangs on the two heads before it, so doubts are settled in order.
    is_head = bytearray(b"\x01") * heads.size
    for i, is_twice in zip(doubtful.tolist(), is_reached_twice.tolist(), strict=True):
        is_head[i] = not (is_head[i - 1] or (is_twice and is_head[i - 2]))
    return heads[np.frombuffer(is_head, np.bool_)]


def _place_short_steps(step: _Words, code: _Bytes, at: _Indices) -> None:
    # Second steps first: those that are none write a zero where the next byte's first step goes.
    step[at + 1] = _SECOND_STEP[code]
    step[at] = _FIRST_STEP[code]


def _place_long_steps(step: _Words, padded: _Bytes, escapes: _Indices, at: _Indices) -> None:
    """Write the long steps; a rank given whole becomes the step that leads there from what came before."""
    argument = padded[escapes + 1].astype(np.uint16)
    step[at] = 192 - argument
    is_whole = argument < 0x80
    whole = at[is_whole]
    if not whole.size:
        return
    step[whole] = 0
    rank = (argument[is_whole] << 8) | padded[escapes[is_whole] + 2]
    walked = np.add.reduceat(step, np.concatenate([[0], whole]), dtype=np.uint16)[:-1]
    walked[1:] += rank[:-1]
    step[whole] = rank - walked


def encode_16zt(depth_mm: DepthImage) -> bytes:
    """Encode one depth picture, shape (rows, columns), to the bytes the runtime's own recorder writes.

    But for one thing: it swaps the last single step with the run of zero steps before it, and so loses the last pixels
    of such a picture. Here they are kept.

    Raises
    ------
    ValueError
        The picture holds more than 32,768 different depths, which this codec cannot say.
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
    """Read rows and columns from the head, so that a lying head never costs memory."""
    if bytes(payload[:2]) != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(payload) and payload[at] == 0xFF:
        marker, length = payload[at + 1], int.from_bytes(payload[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            return int.from_bytes(payload[at + 5 : at + 7], "big"), int.from_bytes(payload[at + 7 : at + 9], "big")
        at += 2 + length
    return None
