"""Writes the frames an engine sees to an ``.oni`` file while it sees them, to the last bit, in a thread of its own.

Pictures are written as they are: to code depth costs a fifth of a core at 30 frames a second, which the engine needs,
and no code for colour that the runtime plays keeps every bit. A colour picture lies in the file before the first depth
picture it was paired with.

The gate's way never waits for it. Where the disk is too slow, too full or gone, the recording ends there and says why;
the beam is not held for it, since a raw recording is for looking back, and no record of what the gate did hangs on it.
"""

import queue
import shutil
import threading
from contextlib import suppress
from pathlib import Path

from engine.frames import ColorImage, RgbdFrame
from engine.oni.writer import OniWriter

FRAMES_KEPT = 30
"""A second of frames, some 46 MB: a disk that takes longer to come back is too slow."""

CHECK_EVERY_FRAMES = 30
TOO_SLOW = "the disk is too slow for the raw recording"
PART_SUFFIX = ".part"


def part_of(path: Path) -> Path:
    """Return the name a raw recording has until it is whole, and keeps where the process was killed."""
    return path.with_name(path.name + PART_SUFFIX)


class RawRecorder(threading.Thread):
    """Records one session's frames.

    Parameters
    ----------
    path
        The recording to make; it has the name of :func:`part_of` until it is whole.
    min_free_bytes
        How much of the disk has to stay free; the recording ends before.

    Attributes
    ----------
    error
        Why the recording ended early; None as long as it did not.
    """

    def __init__(self, path: Path, *, min_free_bytes: float, frames_kept: int = FRAMES_KEPT) -> None:
        super().__init__(name="tidegate-raw", daemon=True)
        self._path = path
        self._min_free_bytes = min_free_bytes
        self._frames: queue.Queue[RgbdFrame | None] = queue.Queue(frames_kept)
        self._color: ColorImage | None = None
        self.error: str | None = None

    def offer(self, frame: RgbdFrame) -> str | None:
        """Leave a frame, from the engine's thread; return why the recording has ended, if it has."""
        if self.error is None:
            try:
                self._frames.put_nowait(frame)
            except queue.Full:
                self.error = TOO_SLOW
        return self.error

    def finish(self, timeout_s: float) -> str | None:
        """Let what waits be written, and the file get its name; return why that is not all of it, if it is not."""
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
        """Write what comes; keeps what was written whatever ends it."""
        try:
            self._record()
        except Exception as error:  # noqa: BLE001 - whatever it was: there is no raw recording from here on, and no more
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
