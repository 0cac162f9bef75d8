"""A camera of your own: here one that plays a recording for ever, as if it were live (LOOP_RECORDING names it)."""

import os
import time
from dataclasses import replace

import tidegate
from tidegate.plug_ins import (
    CameraOptions,
    CameraPlugIn,
    Clock,
    FrameTimeoutError,
    ListedCamera,
    RgbdFrame,
    SourceDescription,
)


class LoopCamera:
    """Frames in the device's time; the recording is read again and again."""

    is_free = True  # no call of it hangs in an SDK

    def __init__(self, path: str, clock: Clock) -> None:
        self._path, self._clock = path, clock
        self._index = self._offset_us = self._last_us = 0

    def open(self) -> SourceDescription:
        """Start."""
        source = tidegate.open_recording(self._path)
        self._frames, self._next = iter(source), None
        self._next = next(self._frames)
        self._began_ns = self._clock.now_ns() - 1000 * self._next.timestamp_us
        found = source.description
        return replace(found, name="Loop", is_live=True, kind="camera", cold_share=None)

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame when it is due."""
        frame = self._next
        at_us = frame.timestamp_us + self._offset_us
        rest_s = (self._began_ns + 1000 * at_us - self._clock.now_ns()) / 1e9
        empty_ns = self._clock.now_ns()
        time.sleep(max(0.0, min(rest_s, timeout_s)))
        if rest_s > timeout_s:
            raise FrameTimeoutError("no frame is due yet")
        now = replace(
            frame,
            index=self._index,
            device_index=self._index,
            missed_frames=0,
            timestamp_us=at_us,
            color_timestamp_us=frame.color_timestamp_us + self._offset_us,
            received_ns=self._clock.now_ns(),
            queue_empty_ns=empty_ns,
        )
        self._index += 1
        self._next = next(self._frames, None)
        if self._next is None:  # from the beginning, a frame later
            self._frames = iter(tidegate.open_recording(self._path))
            self._next = next(self._frames)
            self._offset_us = at_us + 33_333 - self._next.timestamp_us
        return now

    def close(self) -> None:
        """Stop."""
        self._frames = iter(())


class LoopDriver(CameraPlugIn):
    """One camera, where LOOP_RECORDING names a recording."""

    prefix, label, warm_up_s = "loop:", "the loop", 0.0
    install_hint = "set LOOP_RECORDING"

    def list_cameras(self) -> list[ListedCamera]:
        """List the recording."""
        return [ListedCamera(uri="loop:1", vendor="Example", name="Loop")] if os.environ.get("LOOP_RECORDING") else []

    def open(self, uri: str, clock: Clock, options: CameraOptions) -> LoopCamera:
        """Return the camera."""
        return LoopCamera(os.environ["LOOP_RECORDING"], clock)


DRIVER = LoopDriver()
