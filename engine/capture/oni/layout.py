"""The bytes around the pictures of an ``.oni`` file: header, record heads, nodes and properties.

A file is a 24-byte header and a chain of records: head, fields, payload. Since 1.0.1.0 a head is 28 bytes (64-bit undo
position); before, 24. Everything is little-endian and packed.
"""

import enum
import struct

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
