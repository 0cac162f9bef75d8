"""The thread that reads frames from the OpenNI2 runtime as they come, and pairs them for the engine thread.

A live driver is given a moment of silence before each read. A driver that has frames waiting hands over the next one at
once, so a moment without a frame shows that it had none, and that the next frame is fresh (ADR 0025).
"""

import threading
import time
from collections import deque
from dataclasses import dataclass

from engine.capture.openni.c_api import run_on_lasting_thread
from engine.capture.openni.device import DEPTH, DeviceFrame, OpenNiDevice
from engine.core.clock import NS_PER_MS, Clock
from engine.core.errors import FrameTimeoutError, SourceEndedError, SourceLostError

_HELD_DEPTHS, _HELD_COLORS = 8, 8
_POLL_MS = 50
_STOP_TIMEOUT_S = 2.0
# The last frames of a file come after the notification of its end.
_SILENT_POLLS_AT_END = 6
# So many depth frames may come after one before its colour frame is taken to be missing.
_PATIENCE_FRAMES = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReceivedFrame:
    """A frame and when it was received [ns, host monotonic].

    ``queue_empty_ns`` is when the driver was last known to have no frame waiting; None where that is not known.
    """

    frame: DeviceFrame
    received_ns: int
    queue_empty_ns: int | None = None


class CapturePump:
    """Reads frames from the runtime as they come.

    Parameters
    ----------
    silence_ms
        Time without a frame of either stream that shows that none waits in the driver: longer than a driver takes to
        hand over the next one, shorter than the longest pause of two streams. None for a file, which is played.
    last_color_us
        Time of a file's last colour frame: after it none is waited for.
    """

    def __init__(
        self, device: OpenNiDevice, clock: Clock, *, silence_ms: int | None = None, last_color_us: int | None = None
    ) -> None:
        self._device = device
        self._clock = clock
        self._silence_ms, self._last_color_us = silence_ms, last_color_us
        self._queue_empty_ns: int | None = None
        self._changed = threading.Condition()
        self._depths: deque[ReceivedFrame] = deque(maxlen=_HELD_DEPTHS)
        self._colors: deque[ReceivedFrame] = deque(maxlen=_HELD_COLORS)
        self._is_over = False
        self._has_ended = False
        self._stop_requested = threading.Event()
        self._done = threading.Event()

    def start(self) -> None:
        """Start reading frames."""
        self._done = run_on_lasting_thread(self._run)

    def _run(self) -> None:
        """Read until a stop is requested, or the recording or the device ends."""
        try:
            self._take_frames()
        finally:
            with self._changed:
                self._has_ended = True
                self._changed.notify_all()

    def _take_frames(self) -> None:
        silent_polls = 0
        while not self._stop_requested.is_set() and not self._is_over and self._device.lost() is None:
            self._listen()
            frame = self._device.wait(_POLL_MS)
            if frame is not None:
                silent_polls = 0
                received = ReceivedFrame(
                    frame=frame, received_ns=self._clock.now_ns(), queue_empty_ns=self._queue_empty_ns
                )
                with self._changed:
                    (self._depths if frame.stream == DEPTH else self._colors).append(received)
                    self._changed.notify_all()
            else:
                silent_polls += 1
                self._is_over = self._device.is_over and silent_polls >= _SILENT_POLLS_AT_END

    def _listen(self) -> None:
        """Note when the driver is known to have had no frame waiting, if it is silent now.

        Noted is the earliest time at which the silence can have ended. One that was too short by the engine's clock
        does not count: the runtime waits by the wall clock, which can be set.
        """
        if self._silence_ms is None:
            return
        end_ns = self._clock.now_ns() + self._silence_ms * NS_PER_MS
        if self._device.is_silent(self._silence_ms) and self._clock.now_ns() >= end_ns:
            self._queue_empty_ns = end_ns

    def stop(self) -> bool:
        """Request the end; return whether the thread ended, which it does not while a driver hangs."""
        self._stop_requested.set()
        return self._done.wait(_STOP_TIMEOUT_S)

    def await_end(self) -> None:
        """Wait for the end without a timeout."""
        self._done.wait()

    def take(self, timeout_s: float, margin_us: float | None) -> tuple[ReceivedFrame, ReceivedFrame]:
        """Return the next depth frame and its colour frame.

        ``margin_us`` is how far before the depth frame a colour frame may lie and still be taken without waiting for
        the next one; None never waits.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                if not (self._depths and self._colors):
                    self._raise_if_finished()
                elif self._has_color(margin_us):
                    depth = self._depths.popleft()
                    return depth, self._nearest(depth)
                wait_s = deadline_s - time.monotonic()
                if wait_s <= 0.0:
                    msg = f"no frame within {timeout_s:g} s"
                    raise FrameTimeoutError(msg)
                self._changed.wait(wait_s)

    def _has_color(self, margin_us: float | None) -> bool:
        """Whether the colour frame nearest to the first depth frame is certainly received."""
        if margin_us is None or self._has_ended or len(self._depths) > _PATIENCE_FRAMES:
            return True
        newest_us = self._colors[-1].frame.timestamp_us
        return newest_us == self._last_color_us or self._depths[0].frame.timestamp_us - newest_us <= margin_us

    def _nearest(self, depth: ReceivedFrame) -> ReceivedFrame:
        return min(self._colors, key=lambda color: abs(color.frame.timestamp_us - depth.frame.timestamp_us))

    def _raise_if_finished(self) -> None:
        lost = self._device.lost()
        if lost is not None:
            raise SourceLostError(lost)
        if self._is_over:
            msg = "the recording has ended"
            raise SourceEndedError(msg)
        if self._has_ended:
            msg = "the capture has ended"
            raise SourceLostError(msg)
