"""Writes ``.oni`` files that the OpenNI2 runtime plays.

Same input, same bytes. The file has another name until it is whole, so nothing half-written is ever taken for a
recording.
"""

import struct
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np

from engine.capture.oni import records
from engine.capture.oni.codec import encode_16zt, encode_jpeg
from engine.capture.oni.records import COLOR_NODE, DEPTH_NODE, NodeType, RecordType
from engine.core.frames import ColorImage, DepthImage

# An Xtion's and a Carmine's field of view, horizontal and vertical [rad].
XTION_DEPTH_FOV_RAD = (1.0225999, 0.79661566)
XTION_COLOR_FOV_RAD = (1.0225999, 0.79661566)
# The runtime reads any one record into a buffer of this size, and refuses a file with a larger one.
_LARGEST_RECORD_BYTES = 1600 * 1200 * 3
_DEPTH_IN_MM, _RGB888 = 100, 200
_XN_RGB24, _XN_GRAYSCALE16 = 1, 4


Payload = bytes | memoryview


@dataclass(slots=True, kw_only=True)
class _Stream:
    """One of the two streams while it is written."""

    node: int
    node_type: NodeType
    name: str
    size_px: tuple[int, int]
    codec: str
    added_at: int = 0
    last_at: int = 0
    frame_id: int = 0
    max_timestamp_us: int = 0
    seek_entries: list[tuple[int, int, int]] = field(default_factory=lambda: [(0, 0, 0)])


class OniWriter:
    """An ``.oni`` file being written; a context manager.

    Leaving the block without an error gives the file its name; an error removes what was written.

    Parameters
    ----------
    path
        Where the recording will be; replaced if it exists.
    depth_size, color_size
        Width and height [px]; ``color_size=None`` makes a file without colour.
    fps
        Nominal rate [1/s]; timestamps carry the true one.
    part_path
        The name it has until it is whole.
    serial
        Serial number of the camera; may be set until the file is closed.
    """

    def __init__(
        self,
        path: Path,
        *,
        depth_size: tuple[int, int] = (640, 480),
        color_size: tuple[int, int] | None = (640, 480),
        fps: float = 30.0,
        depth_fov_rad: tuple[float, float] = XTION_DEPTH_FOV_RAD,
        color_fov_rad: tuple[float, float] = XTION_COLOR_FOV_RAD,
        max_depth_mm: int = 10_000,
        depth_codec: Literal["16zT", "NONE"] = "16zT",
        color_codec: Literal["JPEG", "NONE"] = "JPEG",
        jpeg_quality: int = 92,
        part_path: Path | None = None,
        serial: str = "",
    ) -> None:
        self._path = Path(path)
        self._part_path = part_path or self._path.with_name(f".{self._path.name}.part")
        self._jpeg_quality = jpeg_quality
        self._max_timestamp_us = 0
        self.serial = serial
        self._depth = _Stream(
            node=DEPTH_NODE, node_type=NodeType.DEPTH, name="Depth", size_px=depth_size, codec=depth_codec
        )
        self._streams = [self._depth]
        self._color = None
        if color_size is not None:
            self._color = _Stream(
                node=COLOR_NODE, node_type=NodeType.IMAGE, name="Image", size_px=color_size, codec=color_codec
            )
            self._streams.append(self._color)
        self._file = self._part_path.open("w+b")
        self._write_head(round(fps), depth_fov_rad, color_fov_rad, max_depth_mm)

    def write_depth(self, timestamp_us: int, depth_mm: DepthImage, *, frame_id: int | None = None) -> None:
        """Append a depth frame [mm]; a ``frame_id`` beyond the next one means that frames were lost."""
        _check_shape(depth_mm.shape, self._depth.size_px, depth_mm.dtype, np.dtype(np.uint16))
        is_coded = self._depth.codec == records.CODEC_DEPTH
        payload = encode_16zt(depth_mm) if is_coded else _bytes_of(depth_mm, "<u2")
        self.write_depth_payload(timestamp_us, payload, frame_id=frame_id)

    def write_color(self, timestamp_us: int, rgb: ColorImage, *, frame_id: int | None = None) -> None:
        """Append a colour frame, RGB."""
        stream = self._color_stream()
        _check_shape(rgb.shape[:2], stream.size_px, rgb.dtype, np.dtype(np.uint8))
        is_coded = stream.codec == records.CODEC_JPEG
        payload = encode_jpeg(rgb, self._jpeg_quality) if is_coded else _bytes_of(rgb, "u1")
        self.write_color_payload(timestamp_us, payload, frame_id=frame_id)

    def write_depth_payload(self, timestamp_us: int, payload: Payload, *, frame_id: int | None = None) -> None:
        """Append a depth frame that is encoded already, with this file's codec."""
        self._append(self._depth, timestamp_us, payload, frame_id)

    def write_color_payload(self, timestamp_us: int, payload: Payload, *, frame_id: int | None = None) -> None:
        """Append a colour frame that is encoded already, with this file's codec."""
        self._append(self._color_stream(), timestamp_us, payload, frame_id)

    def flush(self) -> None:
        """Give what was written to the system: a killed process loses none of it."""
        self._file.flush()

    def close(self) -> None:
        """Finish the file and give it its name; safe to call twice."""
        if self._file.closed:
            return
        self._write_tail()
        self._file.close()
        self._part_path.replace(self._path)

    def discard(self) -> None:
        """Give up: remove what was written; safe to call after :meth:`close`, which it does not undo."""
        if not self._file.closed:
            self._file.close()
            self._part_path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def _color_stream(self) -> _Stream:
        if self._color is None:
            msg = "this file is written without colour"
            raise ValueError(msg)
        return self._color

    def _write_head(
        self, fps: int, depth_fov_rad: tuple[float, float], color_fov_rad: tuple[float, float], max_depth_mm: int
    ) -> None:
        self._file.write(self._file_header())
        for stream in self._streams:
            is_depth = stream is self._depth
            width, height = stream.size_px
            stream.added_at = self._file.tell()
            self._file.write(self._node_added(stream, seek_table_at=0))
            self._file.write(
                records.pack_general(stream.node, xnMapOutputMode=struct.pack("<III", width, height, fps))
                + records.pack_integers(
                    stream.node,
                    oniRequiredFrameSize=width * height * (2 if is_depth else 3),
                    xnIsGenerating=1,
                    xnPixelFormat=_XN_GRAYSCALE16 if is_depth else _XN_RGB24,
                    oniPixelFormat=_DEPTH_IN_MM if is_depth else _RGB888,
                )
                + (records.pack_integers(stream.node, xnDeviceMaxDepth=max_depth_mm) if is_depth else b"")
                # Without xnCropping the runtime's player swallows every frame.
                + records.pack_general(
                    stream.node,
                    xnFOV=struct.pack("<dd", *(depth_fov_rad if is_depth else color_fov_rad)),
                    xnCropping=bytes(12),
                )
                + records.pack_record(RecordType.STATE_READY, stream.node)
            )
        for stream in self._streams:
            fields = records.DATA_BEGIN_FIELDS.pack(2**32 - 1, records.UNKNOWN_TIMESTAMP)
            self._file.write(records.pack_record(RecordType.DATA_BEGIN, stream.node, fields))

    def _append(self, stream: _Stream, timestamp_us: int, payload: Payload, frame_id: int | None) -> None:
        frame_id = stream.frame_id + 1 if frame_id is None else frame_id
        if frame_id <= stream.frame_id or timestamp_us < 0:
            msg = f"{stream.name} frame {frame_id} at {timestamp_us} us cannot follow frame {stream.frame_id}"
            raise ValueError(msg)
        at = self._file.tell()
        fields = records.FRAME_FIELDS.pack(timestamp_us, frame_id)
        self._file.write(
            records.pack_record(
                RecordType.NEW_DATA, stream.node, fields, payload_bytes=len(payload), undo_at=stream.last_at
            )
        )
        self._file.write(payload)
        # One entry a number: a lost frame points where the one before it is, so that seeking finds something.
        stream.seek_entries.extend([stream.seek_entries[-1]] * (frame_id - stream.frame_id - 1))
        stream.seek_entries.append((timestamp_us, 0, at))
        stream.frame_id, stream.last_at = frame_id, at
        stream.max_timestamp_us = max(stream.max_timestamp_us, timestamp_us)
        self._max_timestamp_us = max(self._max_timestamp_us, timestamp_us)

    def _write_tail(self) -> None:
        for stream in self._streams:
            self._file.write(records.pack_record(RecordType.NODE_REMOVED, stream.node, undo_at=stream.added_at))
        seek_tables_at = [self._write_seek_table(stream) for stream in self._streams]
        self._file.write(records.pack_record(RecordType.END, 0) + records.pack_camera(self.serial))
        for stream, at in zip(self._streams, seek_tables_at, strict=True):
            self._file.seek(stream.added_at)
            self._file.write(self._node_added(stream, seek_table_at=at))
        self._file.seek(0)
        self._file.write(self._file_header())

    def _write_seek_table(self, stream: _Stream) -> int:
        table = b"".join(records.SEEK_ENTRY.pack(*entry) for entry in stream.seek_entries)
        if len(table) > _LARGEST_RECORD_BYTES:
            return 0  # such a file plays without one; it only seeks slowly
        at = self._file.tell()
        self._file.write(records.pack_record(RecordType.SEEK_TABLE, stream.node, payload_bytes=len(table)) + table)
        return at

    def _file_header(self) -> bytes:
        highest_node = max(stream.node for stream in self._streams)
        return records.FILE_HEADER.pack(records.FILE_MAGIC, *records.VERSION, self._max_timestamp_us, highest_node)

    @staticmethod
    def _node_added(stream: _Stream, *, seek_table_at: int) -> bytes:
        fields = records.NODE_FIELDS.pack(
            stream.node_type,
            stream.codec.encode("ascii"),
            stream.frame_id,
            0,
            stream.max_timestamp_us,
            seek_table_at,
        )
        return records.pack_record(RecordType.NODE_ADDED, stream.node, records.pack_name(stream.name) + fields)


def _bytes_of(picture: DepthImage | ColorImage, kind: str) -> memoryview:
    """Look at a picture's bytes as they lie in the file; copied only where they lie otherwise in memory."""
    return np.ascontiguousarray(picture, kind).data.cast("B")


def _check_shape(
    shape: tuple[int, ...], size_px: tuple[int, int], dtype: np.dtype[np.generic], wanted: np.dtype[np.generic]
) -> None:
    if shape != (size_px[1], size_px[0]) or dtype != wanted:
        msg = f"a picture of {size_px[0]}x{size_px[1]} {wanted} is wanted, not of shape {shape} {dtype}"
        raise ValueError(msg)
