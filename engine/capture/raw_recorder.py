"""Record a session's frames bit by bit to an ``.oni`` file, in a thread of its own.

Pictures are not compressed: coding depth costs a fifth of a core at 30 frames a second, which the engine needs, and no
colour code that the runtime plays is lossless. A colour picture precedes the first depth picture it was paired with.

The engine thread never waits for the recorder. Where the disk is too slow, full or missing, the recording ends with a
reason; the beam is not held, because a raw recording is for later analysis and no record of the gate depends on it.
"""

import queue
import shutil
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from engine.capture.oni.writer import OniWriter
from engine.core.frames import ColorImage, RgbdFrame

if TYPE_CHECKING:
    from collections.abc import Callable

FRAMES_KEPT = 30
"""Frames of one second, about 46 MB: a disk that pauses for longer is too slow."""

CHECK_EVERY_FRAMES = 30
TOO_SLOW = "the disk is too slow for the raw recording"
PART_SUFFIX = ".part"


def part_of(path: Path) -> Path:
    """Return the name of an incomplete raw recording; it remains where the process was killed."""
    return path.with_name(path.name + PART_SUFFIX)


class RawRecorder(threading.Thread):
    """Records one session's frames.

    Parameters
    ----------
    path
        The recording to write; its name is that of :func:`part_of` until it is complete.
    min_free_bytes
        Free disk space at which the recording ends [bytes].

    Attributes
    ----------
    error
        Why the recording ended early; None otherwise.
    serial
        Asked for the camera's serial number before the file is finished.
    """

    def __init__(self, path: Path, *, min_free_bytes: float, frames_kept: int = FRAMES_KEPT) -> None:
        super().__init__(name="tidegate-raw", daemon=True)
        self._path = path
        self._min_free_bytes = min_free_bytes
        self._frames: queue.Queue[RgbdFrame | None] = queue.Queue(frames_kept)
        self._color: ColorImage | None = None
        self.error: str | None = None
        self.serial: Callable[[], str] = str

    def offer(self, frame: RgbdFrame) -> str | None:
        """Queue a frame, from the engine thread; return why the recording has ended, if it has."""
        if self.error is None:
            try:
                self._frames.put_nowait(frame)
            except queue.Full:
                self.error = TOO_SLOW
        return self.error

    def finish(self, timeout_s: float) -> str | None:
        """Write the queued frames and rename the file; return why it is incomplete, if it is."""
        deadline = threading.Timer(timeout_s, self._give_up)
        deadline.daemon = True
        deadline.start()
        with suppress(queue.Full):
            self._frames.put(None, timeout=timeout_s)
        self.join(timeout_s)
        deadline.cancel()
        return TOO_SLOW if self.is_alive() else self.error

    def _give_up(self) -> None:
        self.error = self.error or TOO_SLOW

    def run(self) -> None:
        """Write queued frames until the end; what was written is kept."""
        try:
            self._record()
        except Exception as error:  # noqa: BLE001 - any error ends the raw recording, and nothing else
            self.error = self.error or f"the raw recording cannot be written: {type(error).__name__}"

    def _record(self) -> None:
        frame = self._frames.get()
        if frame is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        writer = OniWriter(
            self._path,
            depth_size=(frame.depth_mm.shape[1], frame.depth_mm.shape[0]),
            color_size=(frame.color.shape[1], frame.color.shape[0]),
            depth_codec="NONE",
            color_codec="NONE",
            part_path=part_of(self._path),
        )
        try:
            written = 0
            while frame is not None and self.error is None:
                self._write(writer, frame)
                written += 1
                if written % CHECK_EVERY_FRAMES == 0:
                    self._see_to_the_disk(writer)
                frame = self._frames.get()
        finally:
            writer.serial = self.serial()
            writer.close()

    def _write(self, writer: OniWriter, frame: RgbdFrame) -> None:
        if frame.color is not self._color:
            writer.write_color(frame.color_timestamp_us, frame.color)
            self._color = frame.color
        writer.write_depth(frame.timestamp_us, frame.depth_mm, frame_id=frame.index + 1)

    def _see_to_the_disk(self, writer: OniWriter) -> None:
        writer.flush()
        if shutil.disk_usage(self._path.parent).free < self._min_free_bytes:
            self.error = "the disk is almost full: the raw recording has ended"
