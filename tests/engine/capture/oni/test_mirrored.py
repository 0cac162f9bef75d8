"""Pictures that are stored mirrored are turned round: left stays left, of each stream by itself, by every player."""

import numpy as np
import pytest

from engine.capture.oni.reader import OniReader, describe
from engine.capture.oni.writer import COLOR_NODE, DEPTH_NODE, OniWriter
from engine.capture.openni.source import OpenNiSource
from engine.capture.recording_source import OniFileSource
from engine.core.clock import MonotonicClock
from tests.support.capture.oni_recordings import PERIOD_US, color_picture, depth_picture, stored_mirrored

SIZE_PX = (320, 240)
NODES = {"both": (DEPTH_NODE, COLOR_NODE), "depth": (DEPTH_NODE,), "colour": (COLOR_NODE,), "none": ()}
NAMES = {"both": "depth and colour", "depth": "depth", "colour": "colour", "none": None}


def turned(picture, *, is_mirrored):
    return np.ascontiguousarray(picture[:, ::-1]) if is_mirrored else picture


def write(path, nodes):
    with stored_mirrored(*nodes), OniWriter(path, depth_size=SIZE_PX, color_size=SIZE_PX) as writer:
        for index in range(12):
            depth, color = depth_picture(index, SIZE_PX), color_picture(index, SIZE_PX)
            writer.write_depth((index + 1) * PERIOD_US, turned(depth, is_mirrored=DEPTH_NODE in nodes))
            writer.write_color((index + 1) * PERIOD_US, turned(color, is_mirrored=COLOR_NODE in nodes))
    return path


@pytest.mark.parametrize("kind", NODES)
def test_our_reader_gives_the_pictures_as_they_were_seen_and_says_what_it_turned(tmp_path, kind):
    path = write(tmp_path / "a.oni", NODES[kind])
    assert describe(path).mirrored == NAMES[kind]
    with OniReader(path) as reader:
        assert reader.mirrored == NAMES[kind]
    source = OniFileSource(path, clock=MonotonicClock())
    source.open()
    for index in range(12):
        frame = source.read(1.0)
        assert np.array_equal(frame.depth_mm, depth_picture(index, SIZE_PX))
        difference = frame.color.astype(int) - color_picture(index, SIZE_PX)
        assert np.abs(difference).mean() < 3.0  # JPEG
    source.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", NODES)
def test_the_runtimes_player_gives_the_same(tmp_path, kind):
    path = write(tmp_path / "a.oni", NODES[kind])
    source = OpenNiSource(path, clock=MonotonicClock())
    source.open()
    frame = source.read(2.0)
    index = frame.device_index - 1
    source.close()
    assert np.array_equal(frame.depth_mm, depth_picture(index, SIZE_PX))
    assert np.abs(frame.color.astype(int) - color_picture(index, SIZE_PX)).mean() < 6.0


TIMES = {
    "all zero": lambda _index: 0,
    "in milliseconds": lambda index: 33 * index,
    "going back": lambda index: 33_367 * index - (500_000 if index >= 20 else 0),
    "fine": lambda index: 33_367 * index,
}


@pytest.mark.parametrize("kind", TIMES)
def test_times_that_no_camera_gives_are_named(tmp_path, kind):
    path = tmp_path / "a.oni"
    with OniWriter(path, depth_size=SIZE_PX, color_size=SIZE_PX) as writer:
        for index in range(40):
            writer.write_depth(TIMES[kind](index), depth_picture(0, SIZE_PX))
            writer.write_color(TIMES[kind](index), color_picture(0, SIZE_PX))
    found = describe(path).impossible_times
    with OniReader(path) as reader:
        start = reader.impossible_start()
    assert (found is None, start is None) == (kind == "fine", kind == "fine")
    if kind == "all zero":
        assert found == "depth: 39 times go back or stand still; colour: 39 times go back or stand still"
    if kind == "in milliseconds":
        assert "depth: 3.03e+04 frames/s by its times" in found
