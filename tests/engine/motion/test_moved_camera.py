"""A couch or camera that moves by some millimetres: every frame is measured, named, and teaches nothing."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from engine.core.frames import LostReason, MeasurementState, Mover
from engine.core.reference import ReferenceMoment
from tests.support.motion import small_scene
from tests.support.motion.pipelines import Played, new_pipeline

pytestmark = pytest.mark.verification

COUCH_MM, FLOOR_MM = 1000.0, 1700.0
PERIOD = 120
"""Frames of a breath."""


@cache
def shown(phase):
    """One of the frames of a breath, over a couch; each comes again after a breath, when it counts as a new picture."""

    def on_couch(depth):
        noise = np.random.default_rng(phase).normal(0.0, 0.9, depth.shape)
        couch = np.rint(COUCH_MM + noise).astype(np.uint16)
        floor = np.rint(FLOOR_MM + 3.0 * noise).astype(np.uint16)
        depth[:, :160], depth[:, 480:] = couch[:, :160], couch[:, 480:]
        depth[:, :64], depth[:, 576:] = floor[:, :64], floor[:, 576:]

    return small_scene.frame(phase, edit=on_couch)


class Room:
    """A patient on a couch before a camera; ``lowered_mm`` is how far patient and couch are below where they were."""

    def __init__(self, model=None):
        self.pipeline, self.camera = new_pipeline(), Played([shown(phase) for phase in range(PERIOD)])
        self.lowered_mm = self.sheet_mm = self.floor_mm = 0
        if model is not None:
            self.pipeline.learner.activate(model)

    def run(self, frames):
        found = []
        for _ in range(frames):
            frame = next(self.camera)
            is_floor = frame.depth_mm > FLOOR_MM - 100.0
            depth_mm = frame.depth_mm + np.where(is_floor, self.floor_mm, self.lowered_mm).astype(np.uint16)
            depth_mm[200:300, 270:370] -= np.uint16(self.sheet_mm)
            found.append(self.pipeline.measure(replace(frame, depth_mm=depth_mm)))
        return found


@pytest.fixture(scope="module")
def learned():
    room = Room()
    while room.pipeline.learner.status.model is None:
        room.run(1)
        assert room.camera.index < 600
    return room.pipeline.learner.status.model


@pytest.fixture
def room(learned):
    """Measured for two breaths; the reference is at the present position."""
    room = Room(learned)
    room.run(20)
    room.pipeline.learner.set_reference()
    assert {one.state for one in room.run(2 * PERIOD)} == {MeasurementState.MEASURING}
    assert {one.doubt for one in room.run(PERIOD)} == {None}
    return room


def lowered(room, mm):
    room.lowered_mm = mm
    found = room.run(PERIOD)
    return found[15:]


def test_every_frame_is_measured_with_the_movement_in_it_and_named(room):
    before = [one.motion.whole_mm for one in room.run(PERIOD)]
    found = lowered(room, 2)
    assert {one.state for one in found} == {MeasurementState.MEASURING}
    assert {one.doubt.reason for one in found} == {LostReason.CAMERA_MOVED}
    assert re.search(r"the couch is (1\.[89]|2\.[01]) mm from where .*: the couch has moved", found[-1].doubt.detail)
    assert found[-1].doubt.moved.mover is Mover.COUCH
    assert found[-1].doubt.moved.by_mm == pytest.approx(2.0, abs=0.15)
    after = [one.motion.whole_mm for one in found]
    assert np.mean(after) == pytest.approx(np.mean(before) - 2.0, abs=0.4)
    assert found[-1].position.height_mm == pytest.approx(-2.0, abs=0.3)
    assert found[-1].breaths[0].rate_per_min is not None


def test_a_camera_that_moved_takes_the_floor_along(room):
    room.floor_mm = 2
    doubt = lowered(room, 2)[-1].doubt
    assert "the camera has moved" in doubt.detail
    assert doubt.moved.mover is Mover.CAMERA


def test_a_doubt_ends_where_it_was_or_with_a_reference(room):
    assert lowered(room, 2)[-1].doubt is not None
    assert lowered(room, 0)[-1].doubt is None
    assert lowered(room, 2)[-1].doubt is not None
    room.pipeline.learner.set_reference()
    found = room.run(PERIOD)
    assert {one.doubt for one in found} == {None}
    assert abs(np.median([one.motion.whole_mm for one in found])) < 6.0
    assert found[-1].position.height_mm == pytest.approx(0.0, abs=0.3)


def test_a_sheet_under_a_moved_camera_is_lost_and_the_camera_is_named(room):
    lowered(room, 2)
    room.sheet_mm = 5
    found = room.run(PERIOD)[15:]
    assert {one.state for one in found} == {MeasurementState.LOST}
    assert {one.lost.reason for one in found} == {LostReason.CAMERA_MOVED}


def test_breaths_from_before_the_movement_are_no_reference(room):
    room.run(2 * PERIOD)
    assert [one.moment for one in room.pipeline.learner.status.reference_proposals]
    room.lowered_mm = 2
    found = room.run(20)
    assert found[-1].doubt is not None
    assert room.pipeline.learner.status.reference_proposals == ()
    room.run(3 * PERIOD)
    proposed = room.pipeline.learner.status.reference_proposals
    exhale = next(one for one in proposed if one.moment is ReferenceMoment.END_EXHALE)
    room.pipeline.learner.set_reference(moment=ReferenceMoment.END_EXHALE)
    found = room.run(PERIOD)
    assert {one.doubt for one in found} == {None}
    assert min(one.motion.whole_mm for one in found) == pytest.approx(0.0, abs=0.4)
    assert exhale.breaths >= 2


def test_what_is_doubted_is_not_learned(room):
    room.lowered_mm = 2
    room.run(20)
    room.pipeline.learner.models.retrain(keeps_reference=True)
    room.run(PERIOD)
    assert room.pipeline.learner.models.progress.frames == 0
    room.lowered_mm = 0
    room.run(PERIOD)
    assert room.pipeline.learner.models.progress.frames > 50
