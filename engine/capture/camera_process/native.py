"""What a module with an SDK provides to the camera's process, and the clock of a device that wraps.

Such a module has the functions of :class:`engine.capture.camera_process.server.SdkModule`. It runs in a process of its
own, so it may block, hang and crash; it must not hide what the device does: a clock that goes back, a number that does
not advance and a picture that comes again are delivered, for the gate to judge.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from engine.capture.source import SourceDescription
from engine.core.frames import ColorImage, DepthImage

FILE = "file:"
"""Prefix of a recording's path, given in place of a serial number."""
INFRARED = "/infrared"
"""Behind a serial number: the infrared picture in place of colour, for a room without light. It has no colour, so what
compares colours with the reference cannot work."""
SIZE_PX = (640, 480)
FPS = 30
FIRST_FRAME_S = 5.0
"""A camera without frames of both streams for this long is refused [s]."""
SETTLE_S = 1.0
"""The exposure of depth is automatic for this long, then fixed [s]."""
UNIT_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NativeFrame:
    """A depth frame and the colour frame paired with it, as the SDK delivered them.

    Attributes
    ----------
    number
        The device's own number of the depth frame.
    timestamp_us, color_timestamp_us
        Device time without wraps [us].
    received_ns, queue_empty_ns
        As in :class:`engine.core.frames.RgbdFrame`.
    """

    number: int
    timestamp_us: int
    color_timestamp_us: int
    received_ns: int
    queue_empty_ns: int | None
    depth_mm: DepthImage
    color: ColorImage


class NativeCamera(Protocol):
    """One camera of an SDK, used by one thread."""

    def open(self) -> SourceDescription:
        """Start the streams; raise SourceLostError with what a person can do."""

    def read(self, timeout_s: float) -> NativeFrame | None:
        """Return the next frame, None where none came in time; raise SourceLostError where the device is gone."""

    def temperature_c(self) -> float | None:
        """Return the temperature of the depth sensor or its projector [degrees C]; None if the camera reports none."""

    def close(self) -> None:
        """Stop the streams; it may hang."""


class DeviceClock:
    """Device times without wraps, of all streams of a device.

    The device's counter returns to 0 after ``period_us`` (2^32 us are 71.6 minutes). Each reading is taken as the
    one nearest to the reading before it, of whichever stream: a step back stays a step back.
    """

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._last_us: int | None = None

    def unwrapped(self, reading_us: int) -> int | None:
        """Return the time without wraps; None for a reading that the counter cannot show."""
        if not 0 <= reading_us < self._period_us:
            return None
        last_us = reading_us if self._last_us is None else self._last_us
        self._last_us = reading_us + self._period_us * round((last_us - reading_us) / self._period_us)
        return self._last_us


def in_mm(depth: DepthImage, unit_mm: float) -> DepthImage:
    """Return depth in whole millimetres; 0 stays "no reading"."""
    if abs(unit_mm - 1.0) < UNIT_TOLERANCE:
        return depth
    whole_mm: DepthImage = np.minimum(np.rint(depth * unit_mm), np.iinfo(np.uint16).max).astype(np.uint16)
    return whole_mm
