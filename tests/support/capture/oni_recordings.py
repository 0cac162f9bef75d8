"""Recordings made in a test, by our writer and, for old software's files, record by record."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

from engine.capture.oni import records
from engine.capture.oni.codec import encode_16zt, encode_jpeg
from engine.capture.oni.records import RecordType
from engine.capture.oni.writer import OniWriter
from engine.core.frames import ColorImage, DepthImage

SIZE_PX = (64, 48)
PERIOD_US = 33_367
COLOR_OFFSET_US = 9_000


def depth_picture(index: int, size_px: tuple[int, int] = SIZE_PX) -> DepthImage:
    """A noisy, holed slope that differs in every frame."""
    rng = np.random.default_rng([7, index])
    width, height = size_px
    slope = 800 + np.arange(width) // 2 + 3 * np.arange(height)[:, None]
    depth = (slope + rng.normal(0.0, 2.0, (height, width)) + index).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.05] = 0
    depth[:, : width // 8] = 0
    return depth


def color_picture(index: int, size_px: tuple[int, int] = SIZE_PX) -> ColorImage:
    """A red to blue slope, brighter with every frame; smooth, so that JPEG keeps it."""
    width, height = size_px
    picture = np.zeros((height, width, 3), np.uint8)
    picture[..., 0] = np.linspace(20, 200, width)
    picture[..., 2] = np.linspace(200, 20, height)[:, None]
    picture[..., 1] = 2 * index % 200
    return cv2.blur(picture, (5, 5))


def write_recording(
    path: Path,
    *,
    frames: int = 12,
    size_px: tuple[int, int] = SIZE_PX,
    color_offset_us: int = COLOR_OFFSET_US,
    period_us: int = PERIOD_US,
    lost_depth: frozenset[int] = frozenset(),
    depth_codec: str = "16zT",
    color_codec: str = "JPEG",
    serial: str = "",
) -> Path:
    """Write ``frames`` pairs; the depth frames in ``lost_depth`` (by number, from 1) are missing."""
    with OniWriter(
        path,
        depth_size=size_px,
        color_size=size_px,
        fps=1e6 / period_us,
        depth_codec=depth_codec,
        color_codec=color_codec,
        serial=serial,
    ) as writer:
        for index in range(frames):
            at_us = index * period_us
            if index + 1 not in lost_depth:
                writer.write_depth(at_us, depth_picture(index, size_px), frame_id=index + 1)
            writer.write_color(at_us + color_offset_us, color_picture(index, size_px))
    return path


class OldRecording:
    """Builds files as OpenNI 1.5 wrote them: 24-byte heads, a device node, shift tables, an unknown end."""

    def __init__(self, *, version: tuple[int, int, int, int] = (1, 0, 0, 6), last_us: int = 2**64 - 1) -> None:
        self.bytes = bytearray(struct.pack("<4sBBHIQI", b"NI10", *version, last_us, 3))
        self._is_old = version < (1, 0, 1, 0)

    def record(self, kind: int, node: int, fields: bytes = b"", payload: bytes = b"") -> None:
        form = "<4sIIIII" if self._is_old else "<4sIIIIQ"
        size = struct.calcsize(form) + len(fields)
        self.bytes += struct.pack(form, b"NIR\0", kind, node, size, len(payload), 0) + fields + payload

    def name(self, name: str) -> bytes:
        return struct.pack("<I", len(name) + 1) + name.encode() + b"\0"

    def node(self, node: int, kind: int, name: str, codec: bytes, frames: int, *, record_kind: int = 13) -> None:
        fields = self.name(name) + struct.pack("<I4s", kind, codec)
        if record_kind in {12, 13}:
            fields += struct.pack("<IQQ", frames, 0, 2**64 - 1)
        if record_kind == 13:
            fields += bytes(4 if self._is_old else 8)
        self.record(record_kind, node, fields)

    def general(self, node: int, name: str, value: bytes) -> None:
        self.record(6, node, self.name(name) + struct.pack("<I", len(value)) + value)

    def integer(self, node: int, name: str, value: int) -> None:
        self.record(3, node, self.name(name) + struct.pack("<IQ", 8, value))

    def frame(self, node: int, timestamp_us: int, frame_id: int, payload: bytes) -> None:
        self.record(10, node, struct.pack("<QI", timestamp_us, frame_id), payload)


def build_old_recording(
    *,
    node_record: int = 13,
    version: tuple[int, int, int, int] = (1, 0, 0, 6),
    color_jpeg: bool = True,
    period_us: int = PERIOD_US,
    frames: int = 27,
) -> bytes:
    """Depth of 640x480 with one hole of three frames, and a frame less of 320x240 colour, after a device node."""
    old = OldRecording(version=version)
    old.node(1, 1, "Device1", b"\0\0\0\0", 0, record_kind=node_record)
    old.record(9, 1)
    old.node(2, 2, "Depth1", b"16zT", frames - 3, record_kind=node_record)
    old.integer(2, "xnIsGenerating", 1)
    old.integer(2, "xnDeviceMaxDepth", 10_000)
    old.general(2, "S2D", np.arange(2048, dtype="<u2").tobytes())
    old.general(2, "D2S", np.arange(10001, dtype="<u2").tobytes())
    old.general(2, "xnMapOutputMode", struct.pack("<III", 640, 480, round(1e6 / period_us)))
    old.general(2, "xnCropping", bytes(12))
    old.record(4, 2, old.name("ZPPS") + struct.pack("<Id", 8, 0.1052))
    old.record(5, 2, old.name("xnInfo") + struct.pack("<I", 3) + b"ab\0")
    old.record(9, 2)
    old.node(3, 3, "Image1", b"JPEG" if color_jpeg else b"NONE", frames - 4, record_kind=node_record)
    old.general(3, "xnMapOutputMode", struct.pack("<III", 320, 240, 30))
    old.integer(3, "xnPixelFormat", 1)
    old.general(3, "xnCropping", bytes(12))
    old.record(9, 3)
    for node, count in ((2, frames - 3), (3, frames - 4)):
        old.record(8, node, struct.pack("<IQ", count, 2**64 - 1))
    number = 0
    for index in range(frames):
        if index not in {10, 11, 12}:
            number += 1
            old.frame(2, 1000 + index * period_us, number, encode_16zt(depth_picture(index, (640, 480))))
        if index < frames - 4:
            picture = color_picture(index, (320, 240))
            old.frame(
                3, 5000 + index * period_us, index + 1, encode_jpeg(picture, 90) if color_jpeg else picture.tobytes()
            )
    for node in (1, 2, 3):
        old.record(7, node)
    old.record(11, 0)
    return bytes(old.bytes)


@contextmanager
def stored_mirrored(*nodes: int) -> Iterator[None]:
    """Have our writer note of these nodes that their pictures are mirrored, where OpenNI2's recorder does."""
    pack = records.pack_record

    def noted(kind: RecordType, node: int, *rest: object, **more: object) -> bytes:
        head = b""
        if kind is RecordType.STATE_READY:
            head = records.pack_property(RecordType.INT_PROPERTY, node, "xnMirror", struct.pack("<Q", node in nodes))
        return head + pack(kind, node, *rest, **more)  # type: ignore[arg-type]

    with patch.object(records, "pack_record", noted):
        yield
