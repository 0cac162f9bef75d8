"""Recordings as MCAP, which Foxglove, Rerun and ``ros2 bag`` open: depth as PNG, colour as JPEG, ROS 2 messages.

Each message is a chunk of its own, so a file that is cut off anywhere gives every picture before the cut.
"""

import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import cv2
import numpy as np

from engine.capture.pictures import JPEG_QUALITY, UNKNOWN, Picture, RecordingHead
from engine.core.errors import InvalidValueError, RecordingError
from engine.core.files import open_plain
from engine.core.frames import DepthImage

if TYPE_CHECKING:
    from mcap.records import Message

DEPTH, COLOR = "/depth/image/compressedDepth", "/color/image/compressed"
INFO = {DEPTH: "/depth/camera_info", COLOR: "/color/camera_info"}
FRAMES = {DEPTH: "depth_camera", COLOR: "color_camera"}
FORMATS = {DEPTH: "16UC1; compressedDepth png", COLOR: "rgb8; jpeg compressed bgr8"}
METADATA, CALIBRATION = "tidegate", "calibration.json"
DEPTH_HEAD = bytes(12)
"""What image_transport puts before a depth's PNG: its format and two parameters that depths in whole mm do not use."""
PNG_MAGIC = b"\x89PNG"
Lens = tuple[tuple[float, ...], tuple[float, ...]]
"""Camera matrix (9, row by row) and distortion (5)."""
ENOUGH, MOST = 2, 30
"""Depth pictures after which the head is known with a colour picture, and without one."""
LARGEST_RECORD = 64 * 1024 * 1024
LARGEST_SIDE = 4096
NS_PER_US = 1_000
_HEADER = (
    "std_msgs/Header header\n{fields}\n"
    "================================================================================\n"
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    "================================================================================\n"
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
_IMAGE = "sensor_msgs/msg/CompressedImage"
_CAMERA = "sensor_msgs/msg/CameraInfo"
_DEFINITIONS = {
    _IMAGE: _HEADER.format(fields="string format\nuint8[] data"),
    _CAMERA: _HEADER.format(
        fields="uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\n"
        "float64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi"
    )
    + "================================================================================\n"
    "MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\n"
    "uint32 height\nuint32 width\nbool do_rectify\n",
}


def require_mcap() -> None:
    """Raise InvalidValueError, naming what installs it, where the package is missing."""
    try:
        import mcap  # noqa: F401
    except ImportError as error:
        msg = "pip install 'tidegate[mcap]'"
        raise InvalidValueError("format", "mcap", f"installed: {msg}") from error


class McapPictureWriter:
    """Writes pictures to an MCAP file, which has another name until it is whole."""

    def __init__(
        self,
        path: Path,
        head: RecordingHead,
        infos: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] | None = None,
    ) -> None:
        """Begin the file; ``infos`` are the lenses of the depth and the colour topic."""
        require_mcap()
        from mcap.writer import CompressionType, Writer

        self._head, self._path = head, Path(path)
        self._part = self._path.with_name(f".{self._path.name}.part")
        self._file = self._part.open("wb")
        self._writer = Writer(self._file, chunk_size=1, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="tidegate")
        self._writer.add_metadata(
            METADATA,
            {
                "serial": head.serial,
                "time_base": head.time_base,
                "mirrored": "no",
                "fps": f"{head.fps:g}",
                "depth_unit": "mm",
                "depth_size": "{}x{}".format(*head.depth_size),
                "color_size": "" if head.color_size is None else "{}x{}".format(*head.color_size),
            },
        )
        if head.calibration:
            self._writer.add_attachment(0, 0, CALIBRATION, "application/json", head.calibration.encode())
        schemas = {
            name: self._writer.register_schema(name, "ros2msg", text.encode()) for name, text in _DEFINITIONS.items()
        }
        topics = [DEPTH] if head.color_size is None else [DEPTH, COLOR]
        self._channels = {topic: self._writer.register_channel(topic, "cdr", schemas[_IMAGE]) for topic in topics}
        self._infos = {
            topic: (self._writer.register_channel(INFO[topic], "cdr", schemas[_CAMERA]), numbers)
            for topic, numbers in (infos or {}).items()
            if topic in topics
        }

    def write(self, picture: Picture) -> None:
        """Append a picture."""
        if picture.depth_mm is not None:
            topic, data = DEPTH, DEPTH_HEAD + _png(picture.depth_mm)
        else:
            topic, data = COLOR, picture.jpeg or _jpeg(picture)
        at_ns = picture.timestamp_us * NS_PER_US
        message = _Cdr().header(at_ns, FRAMES[topic]).text(FORMATS[topic]).octets(data).done()
        self._writer.add_message(self._channels[topic], at_ns, message, at_ns, picture.frame_id)
        if topic in self._infos:
            channel, numbers = self._infos.pop(topic)  # one is enough: it does not change
            size = self._head.depth_size if topic == DEPTH else self._head.color_size
            assert size is not None, "the topic has pictures"
            self._writer.add_message(channel, at_ns, _camera_info(at_ns, topic, size, *numbers), at_ns, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
            self._part.replace(self._path)
        else:
            self._file.close()
            self._part.unlink(missing_ok=True)


class McapPictures:
    """An MCAP file as pictures, read from its beginning; a file that is cut off gives those before the cut.

    Raises
    ------
    RecordingError
        On opening: no MCAP, or one without depth.
    """

    def __init__(self, path: Path) -> None:
        require_mcap()
        self._path = Path(path)
        self.damage: str | None = None
        try:
            with open_plain(self._path):
                pass
        except (OSError, ValueError) as error:
            msg = f"{self._path.name}: cannot be opened ({getattr(error, 'strerror', None) or error})"
            raise RecordingError(msg) from error
        self.head = self._read_head()

    def pictures(self) -> Iterator[Picture]:
        """Yield the pictures of both topics."""
        for topic, message in self._messages():
            picture = _picture(self._path.name, topic, message)
            if picture is not None:
                yield picture

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def _read_head(self) -> RecordingHead:
        stated: dict[str, str] = {}
        color_size: tuple[int, int] | None = None
        depth: list[Picture] = []
        for record in self._records():
            if not isinstance(record, _Found):
                stated |= _stated_by(record)
                continue
            picture = _picture(self._path.name, record.topic, record.message)
            if picture is not None and picture.depth_mm is not None:
                depth.append(replace(picture, depth_mm=picture.depth_mm[:0] if depth else picture.depth_mm))
            elif picture is not None:
                color_size = color_size or _size_of(picture)
            if len(depth) > ENOUGH and (color_size is not None or stated.get("color_size") == "" or len(depth) > MOST):
                break
        if not depth or depth[0].depth_mm is None:
            raise RecordingError(f"{self._path.name}: has no depth picture on a topic of compressedDepth")
        self.damage = None
        height, width = depth[0].depth_mm.shape
        return RecordingHead(
            depth_size=(width, height),
            color_size=color_size,
            fps=_fps(stated.get("fps", ""), [one.timestamp_us for one in depth]),
            serial=stated.get("serial", UNKNOWN),
            time_base=stated.get("time_base", UNKNOWN),
            calibration=stated.get(CALIBRATION, ""),
        )

    def _messages(self) -> "Iterator[tuple[str, Message]]":
        for record in self._records():
            if isinstance(record, _Found):
                yield record.topic, record.message

    def _records(self) -> "Iterator[Any]":
        """Yield messages with their topics, metadata and attachments, until the end or the first damage."""
        from mcap.exceptions import McapError
        from mcap.records import Channel, Footer, Message
        from mcap.stream_reader import StreamReader

        channels: dict[int, Channel] = {}
        has_end = False
        with open_plain(self._path) as file:
            reader = StreamReader(file, validate_crcs=True, record_size_limit=LARGEST_RECORD)
            try:
                for record in reader.records:
                    if isinstance(record, Channel):
                        channels[record.id] = record
                    elif isinstance(record, Message):
                        found = channels.get(record.channel_id)
                        if found is not None:
                            yield _Found(found.topic, record)
                    else:
                        has_end = has_end or isinstance(record, Footer)
                        yield record
            except (McapError, OSError, ValueError, struct.error, EOFError, MemoryError, KeyError, IndexError) as error:
                if not has_end:
                    self.damage = (
                        f"{self._path.name}: ends in the middle, or is damaged ({error or type(error).__name__})"
                    )


def _stated_by(record: Any) -> dict[str, str]:  # noqa: ANN401 - mcap's records have no common type
    """Return what our metadata and the calibration state; nothing of other records."""
    from mcap.records import Attachment, Metadata

    if isinstance(record, Metadata) and record.name == METADATA:
        return dict(record.metadata)
    if isinstance(record, Attachment) and record.name == CALIBRATION:
        return {CALIBRATION: record.data.decode("utf-8", "replace")}
    return {}


def _size_of(picture: Picture) -> tuple[int, int] | None:
    """Return width and height of a JPEG; None where it is none."""
    found = cv2.imdecode(np.frombuffer(picture.jpeg or b"0", np.uint8), cv2.IMREAD_COLOR)
    return None if found is None else (found.shape[1], found.shape[0])


def _fps(stated: str, at_us: list[int]) -> float:
    """Return the stated rate, or that of the times."""
    with suppress(ValueError):
        if 1.0 <= float(stated) <= 1000.0:
            return float(stated)
    usual_us = float(np.median(np.diff(at_us))) if len(at_us) > 1 else 0.0
    return 1e6 / usual_us if usual_us > 0.0 else 30.0


class _Found:
    """A message, and the topic of its channel."""

    def __init__(self, topic: str, message: "Message") -> None:
        self.topic, self.message = topic, message


def _picture(name: str, topic: str, message: "Message") -> Picture | None:
    """Return a message's picture; None where it is of another kind."""
    is_depth = "compressedDepth" in topic
    if not is_depth and not topic.endswith("/compressed"):
        return None
    try:
        at_ns, data = _read_image(message.data)
    except (struct.error, ValueError) as error:
        raise RecordingError(f"{name}: a message of {topic} is no CompressedImage ({error})") from error
    empty = Picture(timestamp_us=(at_ns or message.log_time) // NS_PER_US, frame_id=message.sequence)
    if not is_depth:
        return replace(empty, jpeg=data)
    begin = data.find(PNG_MAGIC, 0, 64)
    depth = None if begin < 0 else cv2.imdecode(np.frombuffer(data, np.uint8, offset=begin), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.dtype != np.uint16 or depth.ndim != 2 or max(depth.shape) > LARGEST_SIDE:
        raise RecordingError(f"{name}: a picture of {topic} is no PNG of 16 bits, one channel, in mm")
    return replace(empty, depth_mm=np.asarray(depth, dtype=np.uint16))


def _png(depth_mm: DepthImage) -> bytes:
    is_done, made = cv2.imencode(".png", depth_mm, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert is_done, "a PNG can be made of any depth picture"
    return made.tobytes()


def _jpeg(picture: Picture) -> bytes:
    from engine.capture.oni.codec import encode_jpeg

    assert picture.rgb is not None, "a picture of colour"
    return encode_jpeg(picture.rgb, JPEG_QUALITY)


class _Cdr:
    """A message in little-endian CDR; numbers are aligned to their size behind the first four bytes."""

    def __init__(self) -> None:
        self._parts = bytearray()

    def number(self, kind: str, value: float) -> Self:
        self._align(struct.calcsize(kind))
        self._parts += struct.pack(f"<{kind}", value)
        return self

    def text(self, value: str) -> Self:
        raw = value.encode() + b"\0"
        self.number("I", len(raw))
        self._parts += raw
        return self

    def octets(self, value: bytes) -> Self:
        self.number("I", len(value))
        self._parts += value
        return self

    def doubles(self, values: tuple[float, ...], *, has_length: bool = False) -> Self:
        if has_length:
            self.number("I", len(values))
        for value in values:
            self.number("d", value)
        return self

    def header(self, at_ns: int, frame: str) -> Self:
        return self.number("i", at_ns // 1_000_000_000).number("I", at_ns % 1_000_000_000).text(frame)

    def done(self) -> bytes:
        return b"\x00\x01\x00\x00" + bytes(self._parts)

    def _align(self, size: int) -> None:
        self._parts += bytes(-len(self._parts) % size)


def _camera_info(
    at_ns: int, topic: str, size: tuple[int, int], matrix: tuple[float, ...], distortion: tuple[float, ...]
) -> bytes:
    width, height = size
    fx, _, cx, _, fy, cy = matrix[:6]
    cdr = _Cdr().header(at_ns, FRAMES[topic]).number("I", height).number("I", width).text("plumb_bob")
    cdr.doubles(distortion, has_length=True).doubles(matrix).doubles((1, 0, 0, 0, 1, 0, 0, 0, 1))
    cdr.doubles((fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0))
    for value in (0, 0, 0, 0, 0, 0):
        cdr.number("I", value)
    return cdr.number("?", False).done()  # noqa: FBT003 - the message's own


def _read_image(data: bytes) -> tuple[int, bytes]:
    """Read time [ns] and data of a CompressedImage."""
    order = "<" if data[1:2] == b"\x01" else ">"
    body = memoryview(data)[4:]
    sec, nanosec, length = struct.unpack_from(f"{order}iII", body)
    place = 12 + length
    for _ in range(2):  # the format's text, then the data
        place += -place % 4
        (length,) = struct.unpack_from(f"{order}I", body, place)
        place += 4
        if place + length > len(body):
            raise ValueError("its length is beyond its end")
        found = bytes(body[place : place + length])
        place += length
    return sec * 1_000_000_000 + nanosec, found
