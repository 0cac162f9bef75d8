"""The pictures inside an ``.oni`` file: ``16zT`` depth to bytes, and JPEG colour to bytes and back.

``16zT`` replaces each depth by its rank among the depths that occur (the embedded table, in front) and writes the steps
between neighbours, previous minus current, in nibbles::

    u16 n, n x u16 table, u16 first rank, then per byte
    0x00..0xdf   two steps, each nibble minus 6; low nibble d: only one step; low nibble f: one step, then a long one
    0xe0..0xfe   that many minus 0xe0 pairs of zero steps
    0xff         a long step
    long step    one byte from 0x80: minus 192; otherwise two bytes: the rank itself, high byte first

:mod:`engine.capture.oni.unpacking` is the inverse. Both are vectorised: a frame has 307,200 pixels, at
thirty frames a second.
"""

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.errors import RecordingError
from engine.core.frames import ColorImage, DepthImage

_Bytes = npt.NDArray[np.uint8]
_Steps = npt.NDArray[np.int16]
_Indices = npt.NDArray[np.intp]

MAX_RANKS = 0x8000
_PAIRS_A_RUN = 15


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
