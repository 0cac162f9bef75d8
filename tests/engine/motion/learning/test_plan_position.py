"""A later fraction's reference is compared with the plan's position, or it is stated why it cannot be."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from engine.core.learning_status import LearningEventKind
from engine.core.reference import SCHEMA_WITHOUT_MOMENT, ReferenceMoment, read_first_reference
from tests.support.motion.scene_session import SceneSession, scene_frames

EXHALE, INHALE, NOW = ReferenceMoment
LEARNED = 760


def lowered(by_mm):
    """The scene with a patient who lies lower."""
    return [replace(one, depth_mm=np.rint(one.depth_mm + by_mm).astype(np.uint16)) for one in scene_frames()]


@pytest.fixture(scope="module")
def learned():
    session = SceneSession(scene_frames())
    session.measure(LEARNED)
    return session


@pytest.fixture(scope="module")
def plan(learned):
    """The first reference of the plan's first fraction."""
    return confirm(copied(learned)).first


def copied(session):
    frames, session.frames = session.frames, []
    other = copy.deepcopy(session)
    session.frames = other.frames = frames
    return other


def confirm(session, moment=EXHALE):
    """Set the reference; return the notice of its taking up."""
    session.pipeline.learner.take_notices()
    session.pipeline.learner.set_reference(moment)
    session.measure(2)
    notices = session.pipeline.learner.take_notices()
    return next(one for one in notices if one.kind is LearningEventKind.REFERENCE_SET)


def later(learned, plan, **changes):
    """A session of another fraction."""
    session = copied(learned)
    session.pipeline.learner.history.restore_plan(replace(plan, **changes))
    return session


def status(session):
    return session.pipeline.learner.status


def test_in_the_first_fraction_nothing_is_compared(learned):
    session = copied(learned)
    confirm(session)
    assert not status(session).is_position_required
    assert status(session).position_check is None
    assert all(one.position_check is None for one in status(session).reference_proposals)


def test_the_same_position_is_at_zero_in_a_later_fraction(learned, plan):
    session = later(learned, plan)
    assert status(session).is_position_required
    assert status(session).position_check is None  # until a reference is confirmed
    notice = confirm(session)
    check = status(session).position_check
    assert np.abs(check.shift_mm).max() < 0.1
    assert np.abs(check.turn_deg).max() < 0.1
    assert notice.figures["position_vertical_mm"] == pytest.approx(check.shift_mm[2], abs=0.001)
    assert notice.figures["position_unknown"] is None
    assert notice.first.moment is EXHALE


def test_a_patient_who_lies_lower_does_so_by_that_much(plan):
    session = SceneSession(lowered(4.0))
    session.pipeline.learner.history.restore_plan(plan)
    session.measure(LEARNED)
    (exhale, inhale) = status(session).reference_proposals
    assert exhale.position_check.shift_mm[2] == pytest.approx(-4.0, abs=0.4)  # seen before it is confirmed
    assert inhale.position_check is None
    confirm(session)
    check = status(session).position_check
    assert check.shift_mm[2] == pytest.approx(-4.0, abs=0.4)
    assert np.abs(check.turn_deg).max() < 0.5


def test_nothing_is_compared_while_the_gate_is_armed(learned, plan):
    session = later(learned, plan)
    session.pipeline.learner.keep_model(is_kept=True)
    session.measure(240)
    assert all(one.position_check is None for one in status(session).reference_proposals)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"calibration_sha256": "f" * 64}, "another calibration"),
        ({"moment": None}, "does not name the moment"),
        ({"moment": INHALE}, "another moment of the breath (end_inhale, not end_exhale)"),
        ({"surface_mm": np.full((135, 3), np.nan)}, "too little"),
    ],
)
def test_what_cannot_be_compared_is_no_move_of_the_patient(learned, plan, changes, words):
    session = later(learned, plan, **changes)
    confirm(session)
    check = status(session).position_check
    assert words in check.unknown
    assert np.isnan(check.shift_mm).all()


def test_after_the_camera_was_away_the_position_is_not_known(learned, plan):
    session = later(learned, plan)
    session.pipeline.camera_returned()
    assert status(session).position_check is None
    session.measure(LEARNED)
    confirm(session)
    assert "disconnected" in status(session).position_check.unknown


def test_the_document_names_the_moment_and_earlier_documents_do_not(plan):
    assert read_first_reference(plan.to_json()).moment is EXHALE
    earlier = plan.to_json().replace('"tidegate.first-reference/2"', f'"{SCHEMA_WITHOUT_MOMENT}"')
    earlier = earlier.replace(', "moment": "end_exhale"', "")
    assert read_first_reference(earlier).moment is None
    with pytest.raises(InvalidValueError, match="moment"):
        read_first_reference(plan.to_json().replace('"end_exhale"', '"some time"'))
