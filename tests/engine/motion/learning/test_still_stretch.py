"""The longest stretch without movement is kept; breathing is none."""

import numpy as np
import pytest

from engine.core.frames import NODE_COLUMNS, NODE_ROWS, RoiDepth
from engine.motion.learning.past_frames import STEP_US, StillStretch
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.learning.training_set import TrainingFrame

ROWS, COLUMNS = np.mgrid[0:NODE_ROWS, 0:NODE_COLUMNS].reshape(2, -1).astype(np.float64)


def vertices(nodes_px, depth_mm):
    return np.column_stack([nodes_px * depth_mm[:, None] / 570.0, depth_mm])


def frame(at_us, *, along_px=0.0, turned_deg=0.0, hole=False):
    """A frame of a breathing patient, whose markers breathe along the body by 1 px."""
    breath = np.sin(2.0 * np.pi * at_us / 4e6)
    depth = np.full((88, 50), 850.0 - 6.0 * breath, dtype=np.float32)
    valid = np.ones(depth.shape, dtype=bool)
    valid[:20] &= not hole
    turn = np.deg2rad(turned_deg)
    nodes = np.column_stack([COLUMNS * 13.0 - 60.0, ROWS * 16.0 - 100.0 + 1.0 * breath + along_px])
    nodes = nodes @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return TrainingFrame(roi=RoiDepth(depth_mm=depth, valid=valid, stride_px=4), timestamp_us=at_us, nodes_px=nodes)


@pytest.fixture
def stretch():
    return StillStretch(TrainingSettings(), vertices)


def add(stretch, from_s, to_s, **changes):
    for at_us in range(int(from_s * 1e6), int(to_s * 1e6), STEP_US):
        assert stretch.is_due(at_us)
        stretch.add(frame(at_us, **changes))


def bounds_s(stretch):
    frames = stretch.longest.frames
    return frames[0].timestamp_us / 1e6, frames[-1].timestamp_us / 1e6


def test_without_frames_there_is_no_stretch(stretch):
    assert stretch.longest.seconds == 0.0
    assert stretch.is_due(0)


def test_breathing_and_holes_are_no_movement(stretch):
    add(stretch, 0, 20)
    add(stretch, 20, 40, hole=True)
    assert bounds_s(stretch) == pytest.approx((0.0, 39.9))


@pytest.mark.parametrize("moved", [{"along_px": 6.0}, {"turned_deg": 4.0}])
@pytest.mark.parametrize(("middle_s", "expected_s"), [(25, (0.0, 24.9)), (15, (15.0, 39.9))])
def test_a_movement_begins_another_stretch_and_the_longer_one_is_kept(stretch, moved, middle_s, expected_s):
    add(stretch, 0, middle_s)
    add(stretch, middle_s, 40, **moved)
    assert bounds_s(stretch) == pytest.approx(expected_s)


@pytest.mark.parametrize("next_s", [28, 10])
@pytest.mark.parametrize("seconds", [30, 12])
def test_a_gap_or_a_clock_that_goes_back_begins_another_stretch(stretch, next_s, seconds):
    add(stretch, 0, 20)
    add(stretch, next_s, next_s + seconds)
    assert bounds_s(stretch) == pytest.approx((next_s, next_s + 29.9) if seconds == 30 else (0.0, 19.9))


def test_frames_are_taken_ten_times_a_second_and_thinned_in_a_long_recording(stretch):
    add(stretch, 0, 1)
    assert not stretch.is_due(950_000)
    assert stretch.is_due(1_000_000)
    add(stretch, 1, 180)
    frames = stretch.longest.frames
    assert len(frames) <= TrainingSettings().max_frames
    steps = np.diff([one.timestamp_us for one in frames])
    assert len(set(steps)) == 1
    assert stretch.longest.seconds == pytest.approx(179.9)
