"""Detect repeated pictures: frames with new times whose depth or colour is old.

Two pictures of a real sensor never agree in every pixel, and two depth pictures hardly ever in more than 70 % of their
readings, however still the patient lies: a reading is whole steps of the sensor, which its noise crosses. So a picture
is old if every pixel of it was seen in one of the last few, since a stuck driver may deliver several buffers in turn;
and a depth picture also if nearly all of its readings are those of the last new one.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from engine.core.clock import NS_PER_MS
from engine.core.frames import RgbdFrame
from engine.core.gate_state import HoldReason
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits

THINNING_PX = 16
"""Step of the rows and columns compared first: different pictures differ there, at a hundredth of the cost."""

EARLIER_PICTURES = 8
"""Number of earlier pictures compared, by their thinned views; as many as a driver has buffers."""

OLD_SHARE = 0.88
"""Share of a depth picture's readings that agree with those of the last new one, from which it is old."""

LEAST_READINGS = 200
"""Fewer readings in a thinned view do not tell a share: then only pictures that agree in every pixel are old."""

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The last pictures of one stream.

    ``since_ns`` is when the last new picture was received, ``repeats`` the number of repeated ones since. ``views``
    holds the thinned views of the last new pictures, ``newest`` that of the newest of them as an array.
    """

    is_depth: bool
    picture: Picture | None = None
    views: deque[bytes] = field(default_factory=lambda: deque(maxlen=EARLIER_PICTURES))
    newest: Picture | None = None
    timestamp_us: int | None = None
    since_ns: int = 0
    repeats: int = 0

    def check(self, picture: Picture, timestamp_us: int, received_ns: int) -> None:
        if timestamp_us == self.timestamp_us:
            return  # paired with another depth frame, with its time unchanged
        self.timestamp_us = timestamp_us
        thinned = picture[::THINNING_PX, ::THINNING_PX]
        view = thinned.tobytes()
        is_old = any(view) and (self._was_seen(view, picture) or (self.is_depth and self._is_nearly_old(thinned)))
        self.picture = picture
        if is_old:
            self.repeats += 1
            return
        self.views.append(view)
        self.newest = thinned.copy()  # the picture's memory may be used again
        self.since_ns, self.repeats = received_ns, 0

    def _was_seen(self, view: bytes, picture: Picture) -> bool:
        """Whether it equals the last picture in every pixel, or the thinned view of an earlier one."""
        if view not in self.views:
            return False
        is_next_to_last = self.repeats == 0 and view == self.views[-1]
        return not is_next_to_last or (self.picture is not None and np.array_equal(self.picture, picture))

    def _is_nearly_old(self, thinned: Picture) -> bool:
        """Whether nearly all of its readings agree with those of the last new picture."""
        readings = int(np.count_nonzero(thinned))
        if self.newest is None or self.newest.shape != thinned.shape or readings < LEAST_READINGS:
            return False
        return bool(np.count_nonzero((self.newest == thinned) & (thinned > 0)) >= OLD_SHARE * readings)


class RepeatedFrames:
    """Compares each picture with earlier ones; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._streams = {"depth": _Stream(is_depth=True), "colour": _Stream(is_depth=False)}

    def check(self, frame: RgbdFrame) -> Interruption | None:
        """Return the hold for repeated pictures; a fault once they last longer than ``max_silence_ms``."""
        depth, color = self._streams.values()
        depth.check(frame.depth_mm, frame.timestamp_us, frame.received_ns)
        color.check(frame.color, frame.color_timestamp_us, frame.received_ns)
        frozen = {name: stream for name, stream in self._streams.items() if stream.repeats > 0}
        for name, stream in frozen.items():
            repeated_ms = (frame.received_ns - stream.since_ns) / NS_PER_MS
            if repeated_ms > self._limits.max_silence_ms:
                return Interruption(HoldReason.FRAME_TIMEOUT, f"the same {name} picture for {repeated_ms:.0f} ms")
        for name, stream in frozen.items():
            if stream.repeats > self._limits.max_repeated_frames:
                return Interruption(HoldReason.FRAME_FROZEN, f"the {name} picture is repeated ({stream.repeats})")
        return None
