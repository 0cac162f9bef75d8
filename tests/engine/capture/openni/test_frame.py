"""Frames out of the runtime's memory: whole ones are copied, and a head that cannot be true is never believed."""

import ctypes

import numpy as np
import pytest

from engine.capture.openni import c_api as c
from engine.capture.openni.device import COLOR, DEPTH, LATEST_US, copied

pytestmark = pytest.mark.alone

SIZE_PX = (4, 3)
BYTES = {DEPTH: 24, COLOR: 36}


def frame_of(stream, **wrong):
    memory = (ctypes.c_uint8 * BYTES[stream])(*range(BYTES[stream]))
    head = {
        "data_size": BYTES[stream],
        "data": ctypes.addressof(memory),
        "sensor_type": c.SENSOR_COLOR if stream == COLOR else c.SENSOR_DEPTH,
        "timestamp_us": 33_000,
        "frame_index": 7,
        "width": 4,
        "height": 3,
        "stride": BYTES[stream] // 3,
    }
    pixel_format = wrong.pop("pixel_format", c.PIXEL_RGB888 if stream == COLOR else c.PIXEL_DEPTH_1_MM)
    frame = c.Frame(**(head | wrong), video_mode=c.VideoMode(pixel_format, 4, 3, 30))
    return frame, memory


@pytest.mark.parametrize(("stream", "shape"), [(DEPTH, (3, 4)), (COLOR, (3, 4, 3))])
def test_a_whole_frame_is_copied_and_outlives_the_runtime_s_memory(stream, shape):
    frame, memory = frame_of(stream)
    taken = copied(stream, frame, SIZE_PX)
    ctypes.memset(memory, 255, BYTES[stream])
    assert (taken.stream, taken.frame_index, taken.timestamp_us) == (stream, 7, 33_000)
    assert taken.picture.shape == shape
    assert taken.picture.tobytes() == bytes(range(BYTES[stream]))


def test_depth_in_tenths_of_a_millimetre_is_rounded_to_whole_ones():
    frame, memory = frame_of(DEPTH, pixel_format=c.PIXEL_DEPTH_100_UM)
    np.frombuffer(memory, np.uint16)[:3] = (8494, 8495, 0)
    assert copied(DEPTH, frame, SIZE_PX).picture[0, :3].tolist() == [849, 850, 0]


LIES = {
    "too few bytes": {"data_size": 20},
    "a negative size": {"data_size": -24},
    "wider than the stream, with the bytes to match": {"width": 4000, "stride": 8000, "data_size": 24_000},
    "higher": {"height": 3000, "data_size": 24_000},
    "narrower": {"width": 2},
    "a negative width and height": {"width": -4, "height": -3},
    "no rows": {"height": 0},
    "rows with a gap": {"stride": 10},
    "of the other sensor": {"sensor_type": c.SENSOR_COLOR},
    "in another format": {"pixel_format": c.PIXEL_RGB888},
    "without a picture": {"data": None},
    "from another age": {"timestamp_us": LATEST_US + 1},
    "with the largest time there is": {"timestamp_us": 2**64 - 1},
    "with a negative number": {"frame_index": -1},
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES.keys())
def test_a_head_that_cannot_be_true_is_no_frame(lie):
    frame, _memory = frame_of(DEPTH, **lie)
    assert copied(DEPTH, frame, SIZE_PX) is None


def test_a_colour_frame_of_the_depth_sensor_is_no_frame():
    frame, _memory = frame_of(COLOR, sensor_type=c.SENSOR_DEPTH)
    assert copied(COLOR, frame, SIZE_PX) is None
