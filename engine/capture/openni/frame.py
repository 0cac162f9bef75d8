"""One frame copied out of the runtime's memory, or refused: an implausible head makes the picture unusable.

The size of the copy is bounded by the size the stream was started with, never by the frame's own head: a wrong head
would otherwise cause a read beyond the frame's memory.
"""

import ctypes
from dataclasses import dataclass

import numpy as np

from engine.capture.openni import c_api as c
from engine.core.frames import ColorImage, DepthImage

DEPTH, COLOR = 0, 1
SENSOR = (c.SENSOR_DEPTH, c.SENSOR_COLOR)
FORMATS = ((c.PIXEL_DEPTH_1_MM, c.PIXEL_DEPTH_100_UM), (c.PIXEL_RGB888,))
LATEST_US = 2**53
"""Nearly three centuries: no camera has run for longer, and a database keeps no larger time exactly."""

_BYTES_A_PIXEL = (2, 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeviceFrame:
    """A frame copied out of the runtime's memory; ``picture`` is uint16 (H, W) in mm or RGB uint8 (H, W, 3)."""

    stream: int
    frame_index: int
    timestamp_us: int
    picture: DepthImage | ColorImage


def copied(stream: int, frame: c.Frame, size_px: tuple[int, int]) -> DeviceFrame | None:
    """Return a frame of a stream that delivers ``size_px`` (width, height); None where its head cannot be true."""
    width, height = size_px
    stride = width * _BYTES_A_PIXEL[stream]
    needed = stride * height
    is_sound = (
        frame.sensor_type == SENSOR[stream]
        and frame.video_mode.pixel_format in FORMATS[stream]
        and (frame.width, frame.height, frame.stride) == (width, height, stride)
        and frame.data_size >= needed
        and frame.data is not None
        and 0 <= frame.timestamp_us <= LATEST_US
        and frame.frame_index >= 0
    )
    if not is_sound:
        return None
    raw = np.frombuffer(ctypes.string_at(frame.data, needed), np.uint8)
    picture: DepthImage | ColorImage
    if stream == COLOR:
        picture = raw.reshape(height, width, 3)
    else:
        picture = raw.view(np.uint16).reshape(height, width)
        if frame.video_mode.pixel_format == c.PIXEL_DEPTH_100_UM:
            picture = (picture + np.uint16(5)) // np.uint16(10)
    return DeviceFrame(
        stream=stream, frame_index=frame.frame_index, timestamp_us=int(frame.timestamp_us), picture=picture
    )
