"""The simple method: right to a tenth of a millimetre on a quiet scene, and honest about what it left out."""

import numpy as np
import pytest

from engine.motion.settings import PipelineSettings
from lab.evaluation.methods.smoothed import SmoothedPca
from tests.support.motion import small_scene

FRAMES = 150
COVERED = range(60, 65)


@pytest.fixture(scope="module")
def track():
    method = SmoothedPca(small_scene.CALIBRATION, PipelineSettings(), FRAMES)
    for index in range(FRAMES):
        corners = small_scene.CORNERS_PX[: 3 if index in COVERED else 4]
        method.add_frame(small_scene.frame(index, corners_px=corners))
    found = method.track()
    found.finish()
    return found


def test_the_whole_region_moves_as_the_body_does(track):
    first = track.reference
    frames = [index for index in range(first, FRAMES) if index not in COVERED]
    truth = np.array([small_scene.whole_motion_mm(index, first) for index in frames])
    assert np.abs(track.wide_mm[frames, 0] - truth).max() < 0.2
    assert np.ptp(truth) > 3.0


def test_frames_without_markers_and_before_the_steps_are_known_are_left_out(track):
    assert not track.is_measured[list(COVERED)].any()
    assert 0 < track.reference < 20


def test_nothing_is_measured_of_too_few_frames():
    method = SmoothedPca(small_scene.CALIBRATION, PipelineSettings(), FRAMES)
    for index in range(3):
        method.add_frame(small_scene.frame(index))
    assert not method.track().is_measured.any()
