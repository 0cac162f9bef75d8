"""Whether the camera shows the same picture again: frames that come with new times, and show the past.

A real sensor's pictures are never alike in every pixel. Exact equality is asked for: a patient who lies still is no
frozen picture. The last few pictures count, for a buffer that is stuck may hand out several in turn.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from engine.clock import NS_PER_MS
from engine.frames import RgbdFrame
from engine.limits import GateLimits
from engine.permits import HoldReason
from engine.stages.gate import Interruption

THINNING_PX = 16
"""Every so many rows and columns are compared first: pictures that differ do so there, at a hundredth of the time."""

KEPT = 8
"""A driver's buffers: so many pictures that come in turn are known for old ones, by their thinned views."""

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The last pictures of one stream.

    ``since_ns`` is when the newest picture that was new came, ``repeats`` how many have come since that were not.
    """

    picture: Picture | None = None
    views: deque[bytes] = field(default_factory=lambda: deque(maxlen=KEPT))
    timestamp_us: int | None = None
    since_ns: int = 0
    repeats: int = 0

    def look(self, picture: Picture, timestamp_us: int, received_ns: int) -> None:
        if timestamp_us == self.timestamp_us:
            return  # delivered beside another depth frame, and not said to be taken anew
        self.timestamp_us = timestamp_us
        view = picture[::THINNING_PX, ::THINNING_PX].tobytes()
        is_old = any(view) and self._was_seen(view, picture)
        self.picture = picture
        if is_old:
            self.repeats += 1
            return
        self.views.append(view)
        self.since_ns, self.repeats = received_ns, 0

    def _was_seen(self, view: bytes, picture: Picture) -> bool:
        """Whether it is the picture before, in every pixel, or one of those before that."""
        if view not in self.views:
            return False
        is_next_to_last = self.repeats == 0 and view == self.views[-1]
        return not is_next_to_last or (self.picture is not None and np.array_equal(self.picture, picture))


class Repeats:
    """Compares each picture with those before it; owned by the engine thread."""

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
