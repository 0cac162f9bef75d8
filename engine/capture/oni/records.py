"""Walk the records of an ``.oni`` file without trusting its sizes.

One head and its fields are in memory at a time, and a payload only on request. Every size is checked against the file's
own and against a bound before anything is read. A file that is cut or damaged yields its records in order, then raises.

The bytes around the pictures of an ``.oni`` file: header, record heads, nodes and properties.

A file is a 24-byte header and a chain of records: head, fields, payload. Since 1.0.1.0 a head is 28 bytes (64-bit undo
position); before, 24. Everything is little-endian and packed.
"""

import contextlib
import enum
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from engine.core.errors import RecordingError

FILE_HEADER = struct.Struct("<4sBBHIQI")
RECORD_HEAD = struct.Struct("<4sIIIIQ")
RECORD_HEAD_32 = struct.Struct("<4sIIIII")
FRAME_FIELDS = struct.Struct("<QI")
SEEK_ENTRY = struct.Struct("<QIQ")
NODE_FIELDS = struct.Struct("<I4sIQQQ")
DATA_BEGIN_FIELDS = struct.Struct("<IQ")
FILE_MAGIC = b"NI10"
RECORD_MAGIC = b"NIR\0"
VERSION = (1, 0, 1, 0)
FIRST_64_BIT_VERSION = (1, 0, 1, 0)
OLDEST_VERSION = (1, 0, 0, 4)
UNKNOWN_TIMESTAMP = 2**64 - 1

DEPTH_NODE, COLOR_NODE = 1, 2
CODEC_DEPTH, CODEC_JPEG, CODEC_NONE = "16zT", "JPEG", "NONE"
CAMERA_MAGIC = b"TIDEGATE CAMERA\0"
"""Ends a file whose camera is known: its serial number, the number of its bytes, and this, behind the end record, where
no player reads: the runtime's own recorder leaves unused bytes there."""
CAMERA_TAIL = struct.Struct(f"<H{len(CAMERA_MAGIC)}s")
MAX_SERIAL_BYTES = 128
MAX_FIELDS_BYTES = 1 << 20
MAX_PAYLOAD_BYTES = 1 << 25
_FOREIGN = (
    (b"version https://git-lfs", "a Git LFS pointer, not the recording itself: run `git lfs pull`"),
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"PK\x03\x04", "a zip archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"%PDF", "a PDF document"),
    (b"\x93NUMPY", "a numpy array"),
    (b"SQLite format 3", "an SQLite database"),
    (b"#ROSBAG", "a ROS bag"),
)


class RecordType(enum.IntEnum):
    """Type of a record."""

    NODE_ADDED_1_0_0_4 = 2
    INT_PROPERTY = 3
    REAL_PROPERTY = 4
    STRING_PROPERTY = 5
    GENERAL_PROPERTY = 6
    NODE_REMOVED = 7
    DATA_BEGIN = 8
    STATE_READY = 9
    NEW_DATA = 10
    END = 11
    NODE_ADDED_1_0_0_5 = 12
    NODE_ADDED = 13
    SEEK_TABLE = 14


class NodeType(enum.IntEnum):
    """Type of a node."""

    DEVICE = 1
    DEPTH = 2
    IMAGE = 3
    AUDIO = 4
    IR = 5


def pack_record(
    record_type: RecordType, node: int, fields: bytes = b"", *, payload_bytes: int = 0, undo_at: int = 0
) -> bytes:
    """Write head and fields; the payload, if any, comes right behind."""
    size = RECORD_HEAD.size + len(fields)
    return RECORD_HEAD.pack(RECORD_MAGIC, record_type, node, size, payload_bytes, undo_at) + fields


def pack_name(name: str) -> bytes:
    """Write a name: its length with the closing zero, the bytes, the zero."""
    text = name.encode("ascii") + b"\0"
    return struct.pack("<I", len(text)) + text


def pack_property(record_type: RecordType, node: int, name: str, value: bytes) -> bytes:
    """Write one property of a node."""
    return pack_record(record_type, node, pack_name(name) + struct.pack("<I", len(value)) + value)


def pack_integers(node: int, **values: int) -> bytes:
    """Write whole-number properties of a node, in the order given."""
    return b"".join(
        pack_property(RecordType.INT_PROPERTY, node, name, struct.pack("<Q", value)) for name, value in values.items()
    )


def pack_general(node: int, **values: bytes) -> bytes:
    """Write properties of a node that have a layout of their own, in the order given."""
    return b"".join(pack_property(RecordType.GENERAL_PROPERTY, node, name, value) for name, value in values.items())


def pack_camera(serial: str) -> bytes:
    """Write which camera a recording is of, for the very end of its file; nothing for a camera without a number."""
    number = serial.encode() if serial.isprintable() else b""  # a half of a character is not printable
    is_usable = 0 < len(number) <= MAX_SERIAL_BYTES
    return number + CAMERA_TAIL.pack(len(number), CAMERA_MAGIC) if is_usable else b""


def read_camera(file: BinaryIO) -> str:
    """Return the serial number of a recording's camera; empty where the file does not have it."""
    size = os.fstat(file.fileno()).st_size
    file.seek(max(size - CAMERA_TAIL.size - MAX_SERIAL_BYTES, 0))
    end = file.read(CAMERA_TAIL.size + MAX_SERIAL_BYTES)
    if len(end) < CAMERA_TAIL.size or not end.endswith(CAMERA_MAGIC):
        return ""
    length, _ = CAMERA_TAIL.unpack(end[-CAMERA_TAIL.size :])
    serial = end[: -CAMERA_TAIL.size][-length:].decode(errors="replace") if length else ""
    return serial if pack_camera(serial) == end[-CAMERA_TAIL.size - length :] else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class FileHeader:
    """The first 24 bytes; ``last_timestamp_us`` is None where the file does not know."""

    version: tuple[int, int, int, int]
    last_timestamp_us: int | None

    @property
    def record_head(self) -> struct.Struct:
        """Layout of a record's head in this version."""
        is_64_bit = self.version >= FIRST_64_BIT_VERSION
        return RECORD_HEAD if is_64_bit else RECORD_HEAD_32


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """One record, its payload still in the file."""

    at: int
    type: RecordType
    node: int
    fields: bytes
    payload_at: int
    payload_bytes: int


class Fields:
    """Reads the fields of one record from front to back."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self._at = 0

    def unpack(self, form: struct.Struct) -> tuple[int | bytes, ...]:
        """Read fields of the given layout."""
        return form.unpack(self.take(form.size))

    def integer(self, size: int) -> int:
        """Read an unsigned integer of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def block(self) -> bytes:
        """Read a length and that many bytes."""
        return self.take(self.integer(4))

    def name(self) -> str:
        """Read a name; what is not ASCII in it is shown as a question mark."""
        return self.block().split(b"\0", 1)[0].decode("ascii", errors="replace").replace("\ufffd", "?")

    def take(self, size: int) -> bytes:
        """Read ``size`` bytes."""
        part = self._record.fields[self._at : self._at + size]
        if len(part) != size:
            msg = f"damaged at byte {self._record.at}: record {self._record.type.name} is too short"
            raise RecordingError(msg)
        self._at += size
        return part


def read_file_header(file: BinaryIO) -> FileHeader:
    """Read and check the header, and leave the file at the first record."""
    head = file.read(64)
    if not head:
        msg = "empty: the file has no bytes"
        raise RecordingError(msg)
    if not head.startswith(FILE_MAGIC):
        raise RecordingError(f"no OpenNI recording: {_what_it_is(head)}")
    if len(head) < FILE_HEADER.size:
        msg = f"cut within its header, at byte {len(head)}"
        raise RecordingError(msg)
    _, *version, last_us, _ = FILE_HEADER.unpack_from(head)
    major, minor, maintenance, build = version
    if not OLDEST_VERSION <= (major, minor, maintenance, build) <= VERSION:
        msg = f"of format version {major}.{minor}.{maintenance}.{build}: 1.0.0.4 to 1.0.1.0 can be read"
        raise RecordingError(msg)
    file.seek(FILE_HEADER.size)
    is_known = last_us not in {0, UNKNOWN_TIMESTAMP}
    return FileHeader(version=(major, minor, maintenance, build), last_timestamp_us=last_us if is_known else None)


def _what_it_is(head: bytes) -> str:
    for magic, what in _FOREIGN:
        if head.startswith(magic):
            return what
    if all(byte in b"\t\r\n" or byte >= 0x20 for byte in head) and head.isascii():
        return "a text"
    return f"it begins with {head[:4].hex(' ')}, not with NI10"


def walk_records(file: BinaryIO, header: FileHeader) -> Iterator[Record]:
    """Yield every record up to and without the end record.

    The caller may move the file's position between two records.

    Raises
    ------
    RecordingError
        The file is cut or damaged here; everything before it was yielded.
    """
    end = os.fstat(file.fileno()).st_size
    at = FILE_HEADER.size
    while True:
        file.seek(at)
        record = _read_record(file, header.record_head, at, end)
        if record.type is RecordType.END:
            return
        yield record
        at = record.payload_at + record.payload_bytes


def count_records(path: Path, record_type: RecordType) -> int:
    """Count the records of one type in a file that may still be written."""
    count = 0
    with path.open("rb") as file, contextlib.suppress(RecordingError):
        for record in walk_records(file, read_file_header(file)):
            count += record.type is record_type
    return count


def finish(path: Path, serial: str) -> None:
    """Truncate the file after the end record, where the runtime's recorder leaves unused bytes; name the camera."""
    with path.open("r+b") as file:
        header = read_file_header(file)
        at = FILE_HEADER.size
        for record in walk_records(file, header):
            at = record.payload_at + record.payload_bytes
        file.truncate(at + header.record_head.size)
        file.seek(0, os.SEEK_END)
        file.write(pack_camera(serial))


def _read_record(file: BinaryIO, form: struct.Struct, at: int, end: int) -> Record:
    head = file.read(form.size)
    if not head:
        msg = f"cut at byte {at}: the end of the recording is missing"
        raise RecordingError(msg)
    if len(head) < form.size:
        msg = f"cut at byte {end}, within the head of a record"
        raise RecordingError(msg)
    magic, number, node, size, payload_bytes, _ = form.unpack(head)
    if magic != RECORD_MAGIC:
        msg = f"damaged at byte {at}: no record begins there"
        raise RecordingError(msg)
    try:
        record_type = RecordType(number)
    except ValueError:
        msg = f"damaged at byte {at}: there is no record of type {number}"
        raise RecordingError(msg) from None
    if not form.size <= size <= form.size + MAX_FIELDS_BYTES or payload_bytes > MAX_PAYLOAD_BYTES:
        msg = f"damaged at byte {at}: record {record_type.name} claims {size} + {payload_bytes} bytes"
        raise RecordingError(msg)
    if at + size + payload_bytes > end:
        msg = f"cut at byte {end}, within a record {record_type.name} that ends at byte {at + size + payload_bytes}"
        raise RecordingError(msg)
    fields = file.read(size - form.size)
    return Record(at=at, type=record_type, node=node, fields=fields, payload_at=at + size, payload_bytes=payload_bytes)
