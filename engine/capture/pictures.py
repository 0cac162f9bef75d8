"""Pictures of a recording on their way from one format to another, and what a recording says of its camera."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from engine.capture.oni.codec import decode_jpeg
from engine.capture.oni.reader import OniReader
from engine.capture.oni.records import CODEC_JPEG
from engine.capture.oni.writer import OniWriter
from engine.core.errors import RecordingError
from engine.core.frames import ColorImage, DepthImage

UNKNOWN = "unknown"
JPEG_QUALITY = 95


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingHead:
    """What a recording says of itself.

    Attributes
    ----------
    depth_size, color_size
        Width and height [px]; without colour None.
    fps
        Nominal rate of depth [1/s].
    serial
        Of the camera; ``unknown`` where the recording does not say.
    time_base
        What its times are: ``device``, or ``unknown``.
    calibration
        Document of the camera's calibration (JSON); empty without one.
    """

    depth_size: tuple[int, int]
    color_size: tuple[int, int] | None
    fps: float = 30.0
    serial: str = UNKNOWN
    time_base: str = UNKNOWN
    calibration: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """One picture: depth [mm], or colour as RGB or as JPEG; mirrored ones were turned round."""

    timestamp_us: int
    frame_id: int
    depth_mm: DepthImage | None = None
    rgb: ColorImage | None = None
    jpeg: bytes | None = None

    def color(self, shape: tuple[int, int]) -> ColorImage:
        """Return a colour picture as RGB of ``shape`` (rows, columns); raise RecordingError where it is none."""
        if self.rgb is not None:
            return self.rgb
        assert self.jpeg is not None, "a picture of colour"
        return decode_jpeg(self.jpeg, shape)


class PictureReader(Protocol):
    """A recording being read; ``damage`` says why it ended early, after the last picture."""

    @property
    def head(self) -> RecordingHead:
        """What it says of itself."""

    @property
    def damage(self) -> str | None:
        """Why it is not whole; None where it is, or was not read to its end."""

    def pictures(self) -> Iterator[Picture]:
        """Yield its pictures in their order; a damaged recording ends before the damage."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class PictureWriter(Protocol):
    """A recording being written; nothing is left of it where its block is left by an error."""

    def write(self, picture: Picture) -> None:
        """Append a picture."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class OniPictures:
    """An ``.oni`` recording as pictures; JPEG is handed on as it is."""

    def __init__(self, path: Path) -> None:
        self._reader = OniReader(path)
        self.damage: str | None = None
        color = self._reader.color
        self.head = RecordingHead(
            depth_size=self._reader.depth.size_px,
            color_size=None if color is None else color.size_px,
            fps=float(self._reader.depth.fps),
            serial=self._reader.serial or UNKNOWN,
            time_base="device",
        )

    def pictures(self) -> Iterator[Picture]:
        """Yield the pictures of both streams."""
        depth, color = self._reader.depth, self._reader.color
        try:
            for frame in self._reader.frames():
                empty = Picture(timestamp_us=frame.timestamp_us, frame_id=frame.frame_id)
                if frame.is_depth:
                    yield replace(empty, depth_mm=depth.decode_depth(frame.payload))
                elif color is not None and color.codec == CODEC_JPEG and not color.is_mirrored:
                    yield replace(empty, jpeg=bytes(frame.payload))
                elif color is not None:
                    yield replace(empty, rgb=color.decode_color(frame.payload))
        except RecordingError as error:
            self.damage = str(error)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reader.close()


class OniPictureWriter:
    """Writes pictures to an ``.oni`` file."""

    def __init__(self, path: Path, head: RecordingHead) -> None:
        self._last = {True: 0, False: 0}
        self._writer = OniWriter(
            path,
            depth_size=head.depth_size,
            color_size=head.color_size,
            fps=head.fps,
            jpeg_quality=JPEG_QUALITY,
            serial="" if head.serial == UNKNOWN else head.serial,
        )

    def write(self, picture: Picture) -> None:
        """Append a picture; its number is at least the next one, since others leave all at 0."""
        at_us, is_depth = picture.timestamp_us, picture.depth_mm is not None
        number = self._last[is_depth] = max(picture.frame_id, self._last[is_depth] + 1)
        if picture.depth_mm is not None:
            self._writer.write_depth(at_us, picture.depth_mm, frame_id=number)
        elif picture.jpeg is not None:
            self._writer.write_color_payload(at_us, picture.jpeg, frame_id=number)
        elif picture.rgb is not None:
            self._writer.write_color(at_us, picture.rgb, frame_id=number)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(ValueError):  # closed already
            self._writer.__exit__(kind, error, trace)
