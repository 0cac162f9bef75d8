"""Detect repeated pictures: frames with new times whose depth or colour is old.

Two pictures of a real sensor never agree in every pixel, and two depth pictures hardly ever in more than 70 % of their
readings, however still the patient lies: a reading is whole steps of the sensor, which its noise crosses. So a picture
is old if every pixel of it was seen in one picture of the last three seconds, since a stuck driver may deliver several
buffers in turn; and a depth picture also if nearly all of its readings are those of one of them.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from engine.core.frames import Lost, LostReason, RgbdFrame
from engine.core.sentences import say

THINNING_PX = 16
"""Step of the rows and columns compared first: different pictures differ there, at a hundredth of the cost."""

EARLIER_PICTURES = 96
"""Number of earlier pictures compared, by their thinned views: about three seconds, more than a driver has buffers."""

OLD_SHARE = 0.88
"""Share of a depth picture's readings that agree with those of one earlier picture, from which it is old."""

LEAST_READINGS = 200
"""Fewer readings in a thinned view do not tell a share: then only pictures that agree in every pixel are old."""

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The last pictures of one stream.

    ``repeats`` counts the repeated pictures since the last new one. ``views`` holds the thinned views of the last new
    pictures, and ``readings`` those of depth, shape (pictures, readings).
    """

    is_depth: bool
    picture: Picture | None = None
    views: deque[bytes] = field(default_factory=lambda: deque(maxlen=EARLIER_PICTURES))
    readings: Picture | None = None
    oldest: int = 0
    timestamp_us: int | None = None
    repeats: int = 0

    def check(self, picture: Picture, timestamp_us: int) -> None:
        if timestamp_us == self.timestamp_us:
            return  # paired with another depth frame, with its time unchanged
        self.timestamp_us = timestamp_us
        readings = picture[::THINNING_PX, ::THINNING_PX].flatten()
        view = readings.tobytes()
        is_old = any(view) and (self._was_seen(view, picture) or (self.is_depth and self._is_nearly_old(readings)))
        self.picture = picture
        if is_old:
            self.repeats += 1
            return
        self.views.append(view)
        if self.is_depth:
            self._keep(readings)
        self.repeats = 0

    def _was_seen(self, view: bytes, picture: Picture) -> bool:
        """Whether it equals the last picture in every pixel, or the thinned view of an earlier one."""
        if view not in self.views:
            return False
        is_next_to_last = self.repeats == 0 and view == self.views[-1]
        return not is_next_to_last or (self.picture is not None and np.array_equal(self.picture, picture))

    def _is_nearly_old(self, readings: Picture) -> bool:
        """Whether nearly all of its readings agree with those of one of the last new pictures."""
        is_read = (readings > 0).astype(np.float32)
        count = float(is_read.sum())
        if self.readings is None or self.readings.shape[1] != readings.size or count < LEAST_READINGS:
            return False
        # A product of matrices counts the agreeing readings twice as fast as a sum of booleans does.
        agreeing = (self.readings == readings).astype(np.float32) @ is_read
        return bool(agreeing.max() >= OLD_SHARE * count)

    def _keep(self, readings: Picture) -> None:
        """Keep the readings of a new picture in place of the oldest."""
        if self.readings is None or self.readings.shape[1] != readings.size:
            self.readings = np.zeros((EARLIER_PICTURES, readings.size), dtype=readings.dtype)
            self.oldest = 0
        self.readings[self.oldest] = readings
        self.oldest = (self.oldest + 1) % EARLIER_PICTURES


class RepeatedPictures:
    """Compares each picture with earlier ones; owned by one thread."""

    def __init__(self) -> None:
        self._streams = {say("depth"): _Stream(is_depth=True), say("colour"): _Stream(is_depth=False)}

    def check(self, frame: RgbdFrame) -> Lost | None:
        """Return the loss of a frame whose depth or colour picture is old: its values are those of another moment."""
        depth, color = self._streams.values()
        depth.check(frame.depth_mm, frame.timestamp_us)
        color.check(frame.color, frame.color_timestamp_us)
        for name, stream in self._streams.items():
            if stream.repeats > 0:
                return Lost(
                    reason=LostReason.FRAME_FROZEN,
                    detail=say("the {name} picture is repeated ({repeats})", name=name, repeats=stream.repeats),
                )
        return None
