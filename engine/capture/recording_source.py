"""A recording as a frame source, through our own reader: for offline work, and for playing without OpenNI.

Depth and colour have separate jitter and are interleaved in the file, so each depth frame is paired with the colour
frame *nearest in time*, before or after; the file is read ahead as far as necessary. Every depth frame is delivered
once, in order.

At full speed, the next colour picture is decoded on a second core, where there is one, while its depth is decoded and
the frame before is measured. Damage is still reported in its place.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from engine.capture.oni.reader import OniReader
from engine.capture.oni.streams import CodedFrame
from engine.capture.source import SourceDescription
from engine.core.clock import NS_PER_S, NS_PER_US, Clock
from engine.core.errors import FrameTimeoutError, RecordingError, SourceEndedError
from engine.core.frames import ColorImage, DepthImage, RgbdFrame
from engine.core.native_process import keep_freed_memory

# Depth frames held back at most while a colour frame is looked for: eight seconds, some 40 MB.
MAX_LOOK_AHEAD = 256
# Colour frames kept while no depth frame waits: the next one's nearest is the last of them, give or take jitter.
KEPT_COLORS = 8
# A jump in the recording's time is waited for no longer than this, and a pause of the reader's longer than this shifts
# the schedule instead of being made up for.
MAX_WAIT_NS = 2 * NS_PER_S


class _Color:
    """A colour frame, decoded once when first needed."""

    def __init__(self, coded: CodedFrame) -> None:
        self.timestamp_us = coded.timestamp_us
        self._coded = coded
        self._begun: Future[ColorImage] | None = None
        self._picture: ColorImage | None = None

    def begin(self, helper: ThreadPoolExecutor) -> None:
        """Start decoding the picture on the helper thread."""
        if self._begun is None:
            self._begun = helper.submit(self._coded.decode_color)

    def picture(self) -> ColorImage:
        if self._picture is None:
            self._picture = self._coded.decode_color() if self._begun is None else self._begun.result()
            self._picture.setflags(write=False)
        return self._picture


class OniFileSource:
    """A DepthSource over an ``.oni`` file.

    Parameters
    ----------
    path
        The recording; it must hold depth and colour.
    clock
        Stamps ``received_ns`` and, when paced, sets the pace.
    is_paced
        Deliver frames in the recording's own time instead of at once.
    sleep
        Sleeps for so many seconds; replaced in tests.
    is_repeated
        Begin again at the end, until it is closed; numbers and times go on.
    is_helped
        Decode colour on a thread beside the reader's; by default when not paced and on more than one core.
    """

    def __init__(
        self,
        path: Path,
        *,
        clock: Clock,
        is_paced: bool = False,
        is_repeated: bool = False,
        sleep: Callable[[float], None] = time.sleep,
        is_helped: bool | None = None,
    ) -> None:
        self._path = Path(path)
        self._clock = clock
        self._pace = _Pace(clock, sleep) if is_paced else None
        self._is_repeated = is_repeated
        self._is_helped = not is_paced and len(os.sched_getaffinity(0)) > 1 if is_helped is None else is_helped
        self._helper: ThreadPoolExecutor | None = None
        self._reader: OniReader | None = None
        self._frames: Iterator[_Decoded] = iter(())
        self._next: _Decoded | None = None
        self._damage: RecordingError | None = None
        self._index = 0

    def open(self) -> SourceDescription:
        """Open the file and read its first frame.

        Raises
        ------
        RecordingError
            No recording, one without depth or colour, or one damaged before its first frame.
        """
        self.close()
        keep_freed_memory()
        self._reader = reader = OniReader(self._path)
        try:
            description = _describe(reader)
            if self._is_helped:
                self._helper = ThreadPoolExecutor(max_workers=1, thread_name_prefix="color-decoder")
            self._frames = _decode(reader, self._coded(reader), self._helper)
            self._next = _first(reader, self._frames)
        except RecordingError:
            self.close()
            raise
        self._damage = None
        self._index = 0
        return description

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame; see :class:`engine.capture.source.DepthSource`."""
        ready = self._upcoming()
        if self._pace is not None:
            self._pace.wait_for(ready.coded.timestamp_us, timeout_s)
        self._next = None
        frame = RgbdFrame(
            index=self._index,
            device_index=ready.coded.frame_id,
            missed_frames=ready.coded.missed_frames,
            timestamp_us=ready.coded.timestamp_us,
            color_timestamp_us=ready.color_timestamp_us,
            received_ns=self._clock.now_ns(),
            depth_mm=ready.depth_mm,
            color=ready.color,
        )
        self._index += 1
        return frame

    def close(self) -> None:
        """Close the file; safe to call twice, and after a failure."""
        if self._helper is not None:
            self._helper.shutdown(cancel_futures=True)
        self._helper = None
        if self._reader is not None:
            self._reader.close()
        self._reader = None
        self._next = None
        self._frames = iter(())

    def _coded(self, reader: OniReader) -> Iterator[CodedFrame]:
        return reader.repeated_frames() if self._is_repeated else reader.frames()

    def _upcoming(self) -> "_Decoded":
        """Decode the next frame before it is due."""
        if self._damage is not None:
            raise self._damage
        if self._next is None:
            try:
                self._next = next(self._frames, None)
            except RecordingError as error:
                self._damage = error
                raise
        if self._next is None:
            msg = f"{self._path.name} ended after {self._index} frames"
            raise SourceEndedError(msg)
        return self._next


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Decoded:
    """A pair with its decoded pictures."""

    coded: CodedFrame
    depth_mm: DepthImage
    color: ColorImage
    color_timestamp_us: int


def _describe(reader: OniReader) -> SourceDescription:
    if reader.color is None:
        msg = f"{reader.name}: the recording has no colour stream"
        raise RecordingError(msg)
    return SourceDescription(
        kind="recording",
        name=reader.name,
        depth_size=reader.depth.size_px,
        color_size=reader.color.size_px,
        fps=float(reader.depth.fps),
        is_live=False,
        serial=reader.serial,
    )


def _first(reader: OniReader, frames: Iterator[_Decoded]) -> _Decoded:
    frame = next(frames, None)
    if frame is None:
        msg = f"{reader.name}: the recording holds no frame"
        raise RecordingError(msg)
    return frame


def _decode(reader: OniReader, frames: Iterator[CodedFrame], helper: ThreadPoolExecutor | None) -> Iterator[_Decoded]:
    pairs = _pair(reader, frames)
    if helper is not None:
        pairs = _begin_ahead(pairs, helper)
    for coded, color in pairs:
        try:
            decoded = _Decoded(
                coded=coded,
                depth_mm=coded.decode_depth(),
                color=color.picture(),
                color_timestamp_us=color.timestamp_us,
            )
        except RecordingError as error:
            msg = f"{reader.name}: depth frame {coded.frame_id} or its colour frame: {error}"
            raise RecordingError(msg) from error
        yield decoded


def _begin_ahead(
    pairs: Iterator[tuple[CodedFrame, _Color]], helper: ThreadPoolExecutor
) -> Iterator[tuple[CodedFrame, _Color]]:
    """Yield pairs, each once the helper has started the next one's colour; damage is raised in its place."""
    held: tuple[CodedFrame, _Color] | None = None
    damage: RecordingError | None = None
    while True:
        try:
            pair = next(pairs, None)
        except RecordingError as error:
            pair, damage = None, error
        if pair is not None:
            pair[1].begin(helper)
        if held is not None:
            yield held
        if pair is None:
            break
        held = pair
    if damage is not None:
        raise damage


def _pair(reader: OniReader, frames: Iterator[CodedFrame]) -> Iterator[tuple[CodedFrame, _Color]]:
    """Yield each depth frame with the colour frame nearest to it in time; a tie goes to the earlier.

    Pairs from before the damage are yielded first; then the damage is raised.
    """
    waiting: deque[CodedFrame] = deque()
    colors: deque[_Color] = deque()
    damage: RecordingError | None = None
    try:
        for coded in frames:
            if coded.is_depth:
                waiting.append(coded)
            else:
                colors.append(_Color(coded))
            while waiting and (_is_settled(waiting[0], colors) or len(waiting) > MAX_LOOK_AHEAD):
                yield _take(reader, waiting, colors)
            if not waiting:
                _keep_last(colors, KEPT_COLORS)
    except RecordingError as error:
        damage = error
    while waiting and (colors or damage is None):
        yield _take(reader, waiting, colors)
    if damage is not None:
        raise damage


def _is_settled(depth: CodedFrame, colors: deque[_Color]) -> bool:
    return bool(colors) and colors[-1].timestamp_us >= depth.timestamp_us


def _take(reader: OniReader, waiting: deque[CodedFrame], colors: deque[_Color]) -> tuple[CodedFrame, _Color]:
    depth = waiting.popleft()
    if not colors:
        msg = f"{reader.name}: no colour frame near depth frame {depth.frame_id}"
        raise RecordingError(msg)
    nearest = min(colors, key=lambda color: abs(color.timestamp_us - depth.timestamp_us))
    while colors[0] is not nearest:
        colors.popleft()
    return depth, nearest


def _keep_last(colors: deque[_Color], count: int) -> None:
    while len(colors) > count:
        colors.popleft()


class _Pace:
    """Delays frames until they are due."""

    def __init__(self, clock: Clock, sleep: Callable[[float], None]) -> None:
        self._clock = clock
        self._sleep = sleep
        self._zero_ns: int | None = None

    def wait_for(self, timestamp_us: int, timeout_s: float) -> None:
        """Return when ``timestamp_us`` is due; raise FrameTimeoutError if that takes longer than ``timeout_s``."""
        now_ns = self._clock.now_ns()
        if self._zero_ns is None:
            self._zero_ns = now_ns - timestamp_us * NS_PER_US
        wait_ns = self._zero_ns + timestamp_us * NS_PER_US - now_ns
        if not -MAX_WAIT_NS <= wait_ns <= MAX_WAIT_NS:
            wait_ns = MAX_WAIT_NS if wait_ns > 0 else 0
            self._zero_ns = now_ns + wait_ns - timestamp_us * NS_PER_US
        if wait_ns <= 0:
            return
        self._sleep(min(wait_ns / NS_PER_S, max(timeout_s, 0.0)))
        if self._clock.now_ns() < now_ns + wait_ns:
            msg = f"no frame within {timeout_s:g} s"
            raise FrameTimeoutError(msg)
