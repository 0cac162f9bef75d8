"""Streams of an ``.oni`` file, from its node and property records, and the decoding of their pictures."""

import struct
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from engine.capture.oni import codec, records
from engine.capture.oni.records import Fields, FileHeader, NodeType, Record, RecordType
from engine.core.errors import RecordingError
from engine.core.frames import ColorImage, DepthImage

MAX_NODES = 64
MAX_NODE_TYPE = 64  # OpenNI 1.x has twelve; only depth and colour matter here
MAX_SIDE_PX = 4096
MAX_PIXELS = 2048 * 1536
_FALLBACK_FPS = 30
_DEPTH_1_MM, _DEPTH_100_UM, _RGB888, _GRAY8 = 100, 101, 200, 202
# OpenNI 1.x numbers its colour formats differently.
_FROM_XN_FORMAT = {1: _RGB888, 3: _GRAY8}
_MODE = struct.Struct("<III")


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamDescription:
    """One stream of a recording.

    Attributes
    ----------
    size_px
        Width and height; (0, 0) until the file has announced them.
    fps
        Nominal rate [1/s].
    claimed_frames
        Highest frame number the file announces; None where it does not know.
    is_mirrored
        Whether its pictures are stored mirrored, as most drivers deliver them; decoding turns them round, so left is
        left.
    """

    name: str
    node_type: int
    codec: str
    claimed_frames: int | None = None
    size_px: tuple[int, int] = (0, 0)
    fps: int = _FALLBACK_FPS
    pixel_format: int = 0
    is_cropped: bool = False
    is_mirrored: bool = False
    has_shift_table: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.size_px[1], self.size_px[0]

    def decode_depth(self, payload: bytes) -> DepthImage:
        """Decode one depth picture [mm]; raise RecordingError if these bytes are none."""
        if self.codec == records.CODEC_DEPTH:
            depth = codec.decode_16zt(payload, self.shape)
        else:
            depth = self._raw(payload, 2).view("<u2").astype(np.uint16).reshape(self.shape)
        if self.is_mirrored:
            depth = np.ascontiguousarray(depth[:, ::-1])
        return (depth + np.uint16(5)) // np.uint16(10) if self.pixel_format == _DEPTH_100_UM else depth

    def decode_color(self, payload: bytes) -> ColorImage:
        """Decode one colour picture to RGB; raise RecordingError if these bytes are none."""
        picture = self._stored_color(payload)
        return np.ascontiguousarray(picture[:, ::-1]) if self.is_mirrored else picture

    def _stored_color(self, payload: bytes) -> ColorImage:
        if self.codec == records.CODEC_JPEG:
            return codec.decode_jpeg(payload, self.shape)
        if self.pixel_format == _GRAY8:
            gray = self._raw(payload, 1).reshape(self.shape)
            return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        return self._raw(payload, 3).reshape(*self.shape, 3).copy()

    def check_readable(self) -> None:
        """Raise RecordingError if this stream's pictures are of a kind that cannot be read."""
        is_depth = self.node_type == NodeType.DEPTH
        kind = "depth" if is_depth else "colour"
        codecs = {records.CODEC_DEPTH, records.CODEC_NONE} if is_depth else {records.CODEC_JPEG, records.CODEC_NONE}
        formats = {0, _DEPTH_1_MM, _DEPTH_100_UM} if is_depth else {0, _RGB888, _GRAY8}
        if self.size_px == (0, 0):
            msg = f"the {kind} stream does not announce the size of its pictures"
        elif self.codec not in codecs:
            msg = f"the {kind} stream is coded as {self.codec}, which cannot be read"
        elif self.pixel_format not in formats:
            msg = f"the {kind} stream has pixel format {self.pixel_format}, which cannot be read"
        elif self.is_cropped:
            msg = f"the {kind} stream is cropped, which cannot be read"
        else:
            return
        raise RecordingError(msg)

    def _raw(self, payload: bytes, bytes_a_pixel: int) -> np.ndarray[tuple[int], np.dtype[np.uint8]]:
        wanted = self.size_px[0] * self.size_px[1] * bytes_a_pixel
        if len(payload) != wanted:
            msg = f"uncompressed picture has {len(payload)} bytes instead of {wanted}"
            raise RecordingError(msg)
        return np.frombuffer(payload, np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class CodedFrame:
    """One frame as stored in the file.

    Attributes
    ----------
    frame_id
        The recording's own number; usually from 1.
    missed_frames
        Frames of this stream that should lie between the one before and this one, by number and by time.
    coded_bytes
        Size of the coded picture.
    payload
        The coded picture; empty where it was not requested.
    """

    stream: StreamDescription
    frame_id: int
    timestamp_us: int
    missed_frames: int
    coded_bytes: int
    payload: bytes

    @property
    def is_depth(self) -> bool:
        """Whether this is a depth frame; colour otherwise."""
        return self.stream.node_type == NodeType.DEPTH

    def decode_depth(self) -> DepthImage:
        """Decode the depth picture [mm]; raise RecordingError if it is damaged."""
        return self.stream.decode_depth(self.payload)

    def decode_color(self) -> ColorImage:
        """Decode the colour picture, RGB; raise RecordingError if it is damaged."""
        return self.stream.decode_color(self.payload)


@dataclass(slots=True)
class NodeTable:
    """The nodes of a file, kept up to date record by record; the first depth and the first colour node count."""

    header: FileHeader
    _nodes: dict[int, StreamDescription] = field(default_factory=dict)

    @property
    def depth(self) -> StreamDescription | None:
        """The depth stream, once the file has announced one."""
        return self._first(NodeType.DEPTH)

    @property
    def color(self) -> StreamDescription | None:
        """The colour stream, once the file has announced one."""
        return self._first(NodeType.IMAGE)

    def stream_of(self, record: Record) -> StreamDescription:
        """Return the stream a frame belongs to."""
        if record.node not in self._nodes:
            msg = f"damaged at byte {record.at}: a frame of node {record.node}, which the file does not have"
            raise RecordingError(msg)
        return self._nodes[record.node]

    def apply(self, record: Record) -> None:
        """Update the nodes from a record; frames, tables and marks change nothing."""
        if record.type in {RecordType.NODE_ADDED, RecordType.NODE_ADDED_1_0_0_5, RecordType.NODE_ADDED_1_0_0_4}:
            self._add(record)
        elif record.type is RecordType.INT_PROPERTY:
            fields = Fields(record)
            self._set_integer(record, fields.name(), fields.block())
        elif record.type is RecordType.GENERAL_PROPERTY:
            fields = Fields(record)
            self._set_general(record, fields.name(), fields.block())

    def _first(self, node_type: NodeType) -> StreamDescription | None:
        return next((node for node in self._nodes.values() if node.node_type == node_type), None)

    def _add(self, record: Record) -> None:
        fields = Fields(record)
        name, number, code = fields.name(), fields.integer(4), fields.take(4)
        if number > MAX_NODE_TYPE or (record.node not in self._nodes and len(self._nodes) >= MAX_NODES):
            msg = f"damaged at byte {record.at}: node {record.node} is of type {number}"
            raise RecordingError(msg)
        frames = 0 if record.type is RecordType.NODE_ADDED_1_0_0_4 else fields.integer(4)
        self._nodes[record.node] = StreamDescription(
            name=name,
            node_type=number,
            codec=code.decode("ascii", errors="replace").rstrip("\0"),
            claimed_frames=frames if 0 < frames < 2**32 - 1 else None,
        )

    def _set_integer(self, record: Record, name: str, value: bytes) -> None:
        number = int.from_bytes(value[:8], "little")
        if name == "oniPixelFormat":
            self._change(record, pixel_format=number)
        elif name == "xnMirror":
            self._change(record, is_mirrored=number != 0)
        elif name == "xnPixelFormat" and self._is(record, NodeType.IMAGE):
            self._change(record, pixel_format=_FROM_XN_FORMAT.get(number, number))

    def _set_general(self, record: Record, name: str, value: bytes) -> None:
        if name == "xnMapOutputMode":
            if len(value) < _MODE.size:
                msg = f"damaged at byte {record.at}: the picture size is {len(value)} bytes long"
                raise RecordingError(msg)
            width, height, fps = _MODE.unpack_from(value)
            if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
                msg = f"damaged at byte {record.at}: pictures of {width}x{height} are not possible"
                raise RecordingError(msg)
            self._change(record, size_px=(width, height), fps=fps if 1 <= fps <= 1000 else _FALLBACK_FPS)
        elif name == "xnCropping":
            self._change(record, is_cropped=any(value[:4]))
        elif name == "S2D":
            self._change(record, has_shift_table=True)

    def _is(self, record: Record, node_type: NodeType) -> bool:
        return record.node in self._nodes and self._nodes[record.node].node_type == node_type

    def _change(self, record: Record, **changes: object) -> None:
        if record.node not in self._nodes:
            msg = f"damaged at byte {record.at}: a property of node {record.node}, which the file does not have"
            raise RecordingError(msg)
        self._nodes[record.node] = replace(self._nodes[record.node], **changes)  # type: ignore[arg-type]
