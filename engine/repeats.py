"""Whether the camera shows the same picture again: frames that come with new times, and show the past.

A real sensor's pictures are never alike in every pixel. Exact equality is asked for: a patient who lies still is no
frozen picture.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.clock import NS_PER_MS
from engine.frames import RgbdFrame
from engine.limits import GateLimits
from engine.permits import HoldReason
from engine.stages.gate import Interruption

THINNING_PX = 16
"""Every so many rows and columns are compared first: pictures that differ do so there, at a hundredth of the time."""

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The newest picture of one stream; ``since_ns`` is when it first came, ``repeats`` how often it came again."""

    picture: Picture | None = None
    timestamp_us: int | None = None
    since_ns: int = 0
    repeats: int = 0

    def look(self, picture: Picture, timestamp_us: int, received_ns: int) -> None:
        if timestamp_us == self.timestamp_us:
            return  # delivered beside another depth frame, and not said to be taken anew
        self.timestamp_us = timestamp_us
        if self.picture is not None and _are_alike(self.picture, picture):
            self.repeats += 1
            return
        self.picture, self.since_ns, self.repeats = picture, received_ns, 0


class Repeats:
    """Compares each picture with the one before it; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._streams = {"depth": _Stream(), "colour": _Stream()}

    def look(self, frame: RgbdFrame) -> Interruption | None:
        """Return what this frame's pictures forbid: a fault once they have stood still for as long as a silence may."""
        depth, color = self._streams.values()
        depth.look(frame.depth_mm, frame.timestamp_us, frame.received_ns)
        color.look(frame.color, frame.color_timestamp_us, frame.received_ns)
        frozen = {name: stream for name, stream in self._streams.items() if stream.repeats > 0}
        for name, stream in frozen.items():
            still_ms = (frame.received_ns - stream.since_ns) / NS_PER_MS
            if still_ms > self._limits.max_silence_ms:
                return Interruption(HoldReason.FRAME_TIMEOUT, f"the same {name} picture for {still_ms:.0f} ms")
        for name, stream in frozen.items():
            if stream.repeats > self._limits.max_repeated_frames:
                return Interruption(HoldReason.FRAME_FROZEN, f"the {name} picture came again ({stream.repeats})")
        return None


def _are_alike(before: Picture, now: Picture) -> bool:
    """Whether two pictures are the same in every pixel; an empty one is no picture, and what sees nothing is lost."""
    step = (slice(None, None, THINNING_PX), slice(None, None, THINNING_PX))
    return np.array_equal(before[step], now[step]) and bool(now.any()) and np.array_equal(before, now)
