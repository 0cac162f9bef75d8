"""A live source whose frames are written to an ``.oni`` file as they are read, for SDKs without such a recorder."""

from pathlib import Path

from engine.capture.oni.writer import OniWriter
from engine.capture.source import LiveSource, SourceDescription
from engine.core.frames import RgbdFrame


class RecordedSource:
    """Writes depth without loss and colour as JPEG; a frame that was lost leaves a gap in the numbers."""

    def __init__(self, source: LiveSource, path: Path) -> None:
        self._source, self._path = source, path
        self._writer: OniWriter | None = None
        self._color_us: int | None = None
        self._number = 0

    @property
    def is_free(self) -> bool:
        """Whether no call of the source hangs in the driver."""
        return self._source.is_free

    def open(self) -> SourceDescription:
        """Open the source, and begin the file."""
        described = self._source.open()
        self._writer = OniWriter(
            self._path,
            depth_size=described.depth_size,
            color_size=described.color_size,
            fps=described.fps,
            part_path=self._path.with_name(f"{self._path.name}.writing"),
            serial=described.serial,
        )
        self._color_us, self._number = None, 0
        return described

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame, once it is written."""
        frame = self._source.read(timeout_s)
        assert self._writer is not None, "read after open"
        if frame.color_timestamp_us != self._color_us:
            self._writer.write_color(frame.color_timestamp_us, frame.color)
            self._color_us = frame.color_timestamp_us
        self._number += 1 + frame.missed_frames
        self._writer.write_depth(frame.timestamp_us, frame.depth_mm, frame_id=self._number)
        return frame

    def close(self) -> None:
        """Close the source, and finish the file."""
        self._source.close()
        if self._writer is not None:
            self._writer.close()
            self._writer = None
