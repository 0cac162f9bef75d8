"""Finds a frame's pictures in a recording by the frame's entry on the tape; forward only, in the order of the frames.

A depth picture is found by its number in the file, its colour picture by its time: of several with that time, the last
one before the depth picture, because a raw recording is written in that order.
"""

from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

from engine.capture.oni.reader import OniReader
from engine.capture.oni.streams import CodedFrame
from engine.core.errors import RecordingError
from engine.core.frames import ColorImage, RgbdFrame
from engine.offline.replay.inputs import FrameHead

LOOK_AHEAD = 256
COLORS_KEPT = 64


class Pictures:
    """The pictures of one recording.

    Parameters
    ----------
    number_of
        The number that a frame's depth picture has in this file.
    """

    def __init__(self, path: Path, number_of: Callable[[FrameHead], int]) -> None:
        self._reader = OniReader(path)
        self._coming: Iterator[CodedFrame] = self._reader.frames()
        self._number_of = number_of
        self._ahead: deque[CodedFrame] = deque()
        self._colors: deque[CodedFrame] = deque(maxlen=COLORS_KEPT)
        self._picture: tuple[CodedFrame, ColorImage] | None = None

    def frame(self, head: FrameHead) -> RgbdFrame:
        """Return the frame; raise RecordingError where the file does not hold it."""
        depth = self._depth(self._number_of(head))
        color = self._color(head.color_timestamp_us)
        if depth is None or depth.timestamp_us != head.timestamp_us or color is None:
            msg = f"{self._reader.name}: frame {head.index} of the session ({head.timestamp_us} us) is not in it"
            raise RecordingError(msg)
        return head.with_pictures(depth.decode_depth(), self._decoded(color))

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _depth(self, number: int) -> CodedFrame | None:
        while True:
            coded = self._next()
            if coded is None or (coded.is_depth and coded.frame_id >= number):
                return coded if coded is not None and coded.frame_id == number else None
            if not coded.is_depth:
                self._colors.append(coded)

    def _color(self, timestamp_us: int) -> CodedFrame | None:
        before = next((one for one in reversed(self._colors) if one.timestamp_us == timestamp_us), None)
        return before or self._color_behind(timestamp_us)

    def _color_behind(self, timestamp_us: int) -> CodedFrame | None:
        while len(self._ahead) < LOOK_AHEAD and (coded := next(self._coming, None)) is not None:
            self._ahead.append(coded)
            if not coded.is_depth and coded.timestamp_us >= timestamp_us:
                break
        return next((one for one in self._ahead if not one.is_depth and one.timestamp_us == timestamp_us), None)

    def _next(self) -> CodedFrame | None:
        return self._ahead.popleft() if self._ahead else next(self._coming, None)

    def _decoded(self, color: CodedFrame) -> ColorImage:
        if self._picture is None or self._picture[0] is not color:
            self._picture = color, color.decode_color()
        return self._picture[1]
