"""A reference is proposed where the last breaths ended, whatever the moment it is asked for."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import Breath
from engine.core.errors import CommandRefusedError
from engine.core.frames import Motion
from engine.core.reference import ReferenceMoment
from engine.motion.learning.prepared_model import Reference
from engine.motion.learning.reference_proposals import ReferenceProposals
from tests.support.gating.streams import motion_of
from tests.support.motion.scene_session import SETTINGS, SceneSession, scene_frames, session_after

EXHALE, INHALE, NOW = ReferenceMoment
BREATH = 120
"""Frames of a breath of the scene."""


@pytest.fixture(scope="module")
def frames():
    return scene_frames()


@pytest.fixture
def session():
    return session_after(760)


def proposed(session):
    return {one.moment: one for one in session.pipeline.learner.status.reference_proposals}


def levels_mm(session, count=BREATH):
    return np.array([one.motion.whole_mm for one in session.measure(count)])


def test_the_mean_of_the_last_ends_of_exhale_and_inhale_is_proposed(session):
    breath = levels_mm(session)
    found = proposed(session)
    depth_mm = np.ptp(breath)
    assert found[EXHALE].level == pytest.approx(breath.min(), abs=0.05 * depth_mm)
    assert found[INHALE].level == pytest.approx(breath.max(), abs=0.05 * depth_mm)
    assert found[EXHALE].percent == pytest.approx(0.0, abs=5.0)
    assert found[INHALE].percent == pytest.approx(100.0, abs=5.0)
    for one in found.values():
        assert one.scatter < 0.02 * depth_mm
        assert 3 <= one.breaths <= 5
        assert one.signal == SETTINGS.breath_signals[0]


def test_a_reference_of_any_of_twenty_moments_is_at_the_end_of_exhale(session):
    for _ in range(20):
        session.measure(BREATH // 20)
        session.pipeline.learner.set_reference(EXHALE)
        breath = levels_mm(session, BREATH)
        assert breath.min() == pytest.approx(0.0, abs=0.05 * np.ptp(breath))
        assert proposed(session)[EXHALE].level == pytest.approx(0.0, abs=0.05 * np.ptp(breath))


def test_the_end_of_inhale_and_the_present_position_can_be_the_reference(session):
    session.pipeline.learner.set_reference(INHALE)
    breath = levels_mm(session)
    assert breath.max() == pytest.approx(0.0, abs=0.05 * np.ptp(breath))
    session.measure(40)
    session.pipeline.learner.set_reference(NOW)
    assert session.next().motion.whole_mm == pytest.approx(0.0, abs=0.3)


def test_volumes_are_measured_from_the_proposed_position_too(session):
    session.pipeline.learner.set_reference(EXHALE)
    volumes_l = np.array([one.motion.volume_l for one in session.measure(BREATH)])
    assert volumes_l.min() == pytest.approx(0.0, abs=0.05 * np.ptp(volumes_l))


def test_nothing_is_proposed_before_two_breaths_are_known(frames):
    session = SceneSession(frames)
    while session.next().motion is None:
        assert proposed(session) == {}
    with pytest.raises(CommandRefusedError, match="fewer than two breaths"):
        session.pipeline.learner.set_reference(EXHALE)
    session.measure(4 * BREATH)
    assert proposed(session).keys() == {EXHALE, INHALE}


@pytest.mark.parametrize("way", ["a gap", "the camera was away"])
def test_positions_from_before_an_interruption_are_not_proposed(session, way):
    if way == "a gap":
        for _ in range(40):
            session.next(color=0 * session.frames[0].color)
    else:
        session.pipeline.camera_returned()
    session.measure(3)
    assert proposed(session) == {}
    with pytest.raises(CommandRefusedError):
        session.pipeline.learner.set_reference(EXHALE)


def test_no_position_from_before_a_gap_is_set_while_the_gap_lasts(session):
    dark = {"color": 0 * session.frames[0].color}
    for _ in range(40):
        session.next(**dark)
    with pytest.raises(CommandRefusedError, match="fewer than two breaths"):
        session.pipeline.learner.set_reference(EXHALE)


def test_a_position_that_no_frame_took_up_within_a_second_is_dropped_and_arming_needs_another(session):
    session.pipeline.learner.set_reference(EXHALE)
    for _ in range(40):
        session.next(color=0 * session.frames[0].color)
    session.measure(3)
    status = session.pipeline.learner.status
    assert not status.has_reference
    assert "set it again" in session.pipeline.learner.take_notices()[-1].detail
    session.pipeline.learner.set_reference(NOW)
    session.measure(2)
    assert session.pipeline.learner.status.has_reference


def test_a_model_that_takes_the_reference_over_takes_the_positions_over(session):
    session.pipeline.learner.set_reference(EXHALE)
    session.measure(1)
    generation = session.pipeline.learner.journal.generation
    session.pipeline.learner.retrain()
    while session.pipeline.learner.journal.generation == generation:
        session.measure(1)
    assert {EXHALE, INHALE} <= proposed(session).keys()
    session.pipeline.learner.set_reference(EXHALE)
    breath = levels_mm(session)
    assert breath.min() == pytest.approx(0.0, abs=0.05 * np.ptp(breath))


# -- the positions alone, on a model of one component -----------------------------------------------------------


class OneComponent:
    """A prepared model whose surface lies as far away as its coefficient."""

    def node_depth_mm(self, coefficients):
        return np.full(4, 850.0) - coefficients[0]

    def reference(self, coefficients, surface, seen_shares):
        plane_mm = float(surface[:, 2].mean())
        return Reference(
            regions_mm=850.0 - coefficients[:1],
            plane_mm=plane_mm,
            volume_l=0.0,
            seen_shares=seen_shares[:1],
            surface_mm=surface,
        )


FRAME_US = 33_333


def followed(proposals, levels, breaths, start_us=0):
    """Feed levels; ``breaths`` maps a frame to the end of exhale [us] that is known from then on."""
    model, exhale_us = followed.model, None
    for index, level in enumerate(levels):
        exhale_us = breaths.get(index, exhale_us)
        surface_mm = np.column_stack([np.zeros((4, 2)), np.full(4, 850.0)])
        motion: Motion = replace(motion_of(level), surface_mm=surface_mm)
        breath = Breath(exhale_us=exhale_us)
        proposals.follow(model, np.array([level]), motion, breath, start_us + index * FRAME_US)


followed.model = OneComponent()


def regions_mm(proposals, now_us):
    position = proposals.position(EXHALE, now_us)
    return None if position is None else float(position.regions_mm[0])


def saw(breaths, frames_each=100):
    """Levels of so many breaths whose ends of exhale are at 0 mm, and when each is known."""
    levels = [4.0 - 4.0 * np.cos(2.0 * np.pi * index / frames_each) for index in range(breaths * frames_each)]
    known = {number * frames_each + 20: number * frames_each * FRAME_US for number in range(1, breaths)}
    return levels, known


def test_a_cough_that_was_taken_for_breaths_is_withdrawn():
    proposals = ReferenceProposals()
    levels, known = saw(5)
    followed(proposals, levels, {**known, 450: 200 * FRAME_US})
    now_us = 500 * FRAME_US
    assert [one.breaths for one in proposals.proposals({}, now_us)] == [2]


def test_old_breaths_are_not_proposed():
    proposals = ReferenceProposals()
    levels, known = saw(4)
    followed(proposals, levels, known)
    assert regions_mm(proposals, 400 * FRAME_US) == pytest.approx(850.0, abs=0.3)
    assert regions_mm(proposals, 400 * FRAME_US + 60_000_000) is None
    assert proposals.proposals({}, 400 * FRAME_US + 60_000_000) == ()


def test_levels_follow_another_reference_and_positions_do_not():
    proposals = ReferenceProposals()
    levels, known = saw(4)
    followed(proposals, levels, known)
    now_us = 400 * FRAME_US
    before, at_mm = proposals.proposals({}, now_us), regions_mm(proposals, now_us)
    proposals.move(motion_of(5.0), motion_of(2.0))
    after = proposals.proposals({}, now_us)
    assert [two.level - one.level for one, two in zip(before, after, strict=True)] == pytest.approx([-3.0, -3.0])
    assert regions_mm(proposals, now_us) == at_mm


def test_a_part_that_was_not_seen_at_one_end_of_exhale_is_unseen_in_the_reference():
    proposals = ReferenceProposals()
    levels, known = saw(4)
    followed(proposals, levels, known)
    assert proposals.position(EXHALE, 400 * FRAME_US).seen_shares[0] == 1.0


def test_breaths_before_the_patient_moved_are_not_averaged_with_those_after_it():
    proposals = ReferenceProposals()
    levels, known = saw(6)
    followed(proposals, [level - (4.0 if index > 350 else 0.0) for index, level in enumerate(levels[:430])], known)
    assert proposals.position(EXHALE, 429 * FRAME_US) is None
    proposals = ReferenceProposals()
    followed(proposals, [level - (4.0 if index > 350 else 0.0) for index, level in enumerate(levels)], known)
    assert regions_mm(proposals, 599 * FRAME_US) == pytest.approx(854.0, abs=0.3)
