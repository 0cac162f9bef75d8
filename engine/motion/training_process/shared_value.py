"""A value in a memory file, which another process maps: its arrays are written once, and never copied by the reader.

A file holds a head, the pickled value, and the contents of its arrays, each aligned for vector instructions. Writing
releases the interpreter's lock, and the arrays that are read are read-only.
"""

import mmap
import os
import pickle
import struct
from collections.abc import Sequence
from typing import TypeVar

from engine.core.errors import TidegateError

T = TypeVar("T")

ALIGNMENT = 64
_HEAD = struct.Struct("<8sQ")
_LENGTH = struct.Struct("<Q")
_MARK = b"tdgvalue"
_PARTS_AT_ONCE = 1000
"""Below the system's limit of buffers in one call, 1024."""


class SharedValueError(TidegateError):
    """A memory file cannot be written, or does not hold a whole value."""

    code = "shared_value_invalid"


def make_file() -> int:
    """Create an empty memory file, and return its descriptor; its memory is freed with its last user."""
    return os.memfd_create("tidegate-training", os.MFD_CLOEXEC)


def write_value(file: int, values: list[T]) -> None:
    """Write the only value of a list into an empty memory file; its arrays are let go one by one, to hold no lock long.

    Raises
    ------
    SharedValueError
        There is not enough memory.
    """
    buffers: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(values[0], protocol=5, buffer_callback=buffers.append)
    values.clear()
    contents: list[bytes | memoryview] = [pickled, *(buffer.raw() for buffer in buffers)]
    lengths = [len(content) for content in contents]
    head = _HEAD.pack(_MARK, len(contents)) + b"".join(map(_LENGTH.pack, lengths))
    parts: list[bytes | memoryview] = []
    for content in (head, *contents):
        parts += [content, bytes(-len(content) % ALIGNMENT)]
    for start in range(0, len(parts), _PARTS_AT_ONCE):
        _write(file, parts[start : start + _PARTS_AT_ONCE])
    parts.clear()
    contents.clear()
    while buffers:
        buffers.pop()


def _write(file: int, parts: Sequence[bytes | memoryview]) -> None:
    try:
        written = os.writev(file, parts)
    except OSError as error:
        raise SharedValueError(f"a value cannot be handed to another process: {error.strerror}") from error
    if written != sum(map(len, parts)):
        msg = "a value cannot be handed to another process: not enough memory"
        raise SharedValueError(msg)


def read_value(file: int) -> object:
    """Map a memory file and return its value; the memory is freed with the last of the value's arrays.

    Raises
    ------
    SharedValueError
        The file does not hold a whole value.
    """
    size = os.fstat(file).st_size
    if size < _HEAD.size:
        msg = "a value from another process is incomplete"
        raise SharedValueError(msg)
    memory = memoryview(mmap.mmap(file, size, prot=mmap.PROT_READ))
    mark, count = _HEAD.unpack_from(memory)
    if mark != _MARK or size < _HEAD.size + count * _LENGTH.size:
        msg = "a value from another process is damaged"
        raise SharedValueError(msg)
    lengths = [_LENGTH.unpack_from(memory, _HEAD.size + place * _LENGTH.size)[0] for place in range(count)]
    at, contents = _aligned(_HEAD.size + count * _LENGTH.size), []
    for length in lengths:
        contents.append(memory[at : at + length])
        at = _aligned(at + length)
    if at != size:
        raise SharedValueError(f"a value from another process has {size} bytes instead of {at}")
    return pickle.loads(contents[0], buffers=contents[1:])  # noqa: S301 - of this program's own processes # nosec B301


def _aligned(at: int) -> int:
    return at + -at % ALIGNMENT
