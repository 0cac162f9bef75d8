"""The first reference of a fraction is kept; later ones state how far they lie from it, over models and restarts."""

import copy
from dataclasses import replace

import cv2
import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from engine.core.frames import NODE_COLUMNS
from engine.core.learning_status import LearningEventKind
from engine.core.reference import SCHEMA, ReferenceMoment, read_first_reference
from engine.motion.learning import reference_history
from tests.support.motion import small_scene
from tests.support.motion.scene_session import SETTINGS, SceneSession, scene_frames

pytestmark = [pytest.mark.long, pytest.mark.verification]

EXHALE, INHALE, NOW = ReferenceMoment
BREATH = 120
SETTLED = 5 * BREATH
"""Frames after which only breaths of the new position are proposed."""


@pytest.fixture(scope="module")
def still():
    return scene_frames()


def lowered(frames, by_mm):
    """The scene with a patient who lies lower."""
    return [replace(one, depth_mm=np.rint(one.depth_mm + by_mm).astype(np.uint16)) for one in frames]


@pytest.fixture(scope="module")
def unconfirmed(still):
    """A session that has learned; nothing was confirmed."""
    session = SceneSession(still)
    session.measure(760)
    return session


@pytest.fixture(scope="module")
def confirmed(unconfirmed):
    """The same behind its first reference, and the notice of it; only to be looked at."""
    session = copied(unconfirmed)
    return session, confirm(session)


@pytest.fixture
def session(confirmed):
    return copied(confirmed[0])


def copied(session):
    """Return a session that goes on by itself; the frames are shared."""
    frames, session.frames = session.frames, []
    other = copy.deepcopy(session)
    session.frames = other.frames = frames
    return other


def confirm(session, moment=EXHALE, **given):
    """Set the reference; return the notice of its taking up."""
    session.pipeline.learner.take_notices()
    session.pipeline.learner.set_reference(moment, **given)
    session.measure(2)
    kinds = {LearningEventKind.REFERENCE_SET, LearningEventKind.ZERO_NEEDED}
    (notice,) = [one for one in session.pipeline.learner.take_notices() if one.kind in kinds]
    return notice


def distance(session, moment=EXHALE):
    return session.pipeline.learner.reference_distance(moment)


def lie(session, frames, count=SETTLED):
    session.frames = frames
    session.measure(count)


def test_only_a_confirmed_reference_is_the_first(unconfirmed):
    session = copied(unconfirmed)
    assert session.pipeline.learner.learned.reference is not None
    assert distance(session) is None
    notice = confirm(session)
    assert notice.first is not None
    assert "first reference of this fraction" in notice.detail
    assert distance(session).distance_mm < 0.1
    assert confirm(session).first is None


def test_small_steps_add_up_and_the_one_beyond_the_budget_is_dropped(session, still):
    lie(session, lowered(still, 1.5))
    first = confirm(session, most_mm=2.0)
    assert first.kind is LearningEventKind.REFERENCE_SET
    assert first.figures["distance_mm"] == pytest.approx(1.5, abs=0.25)
    lie(session, lowered(still, 3.0))
    assert distance(session).distance_mm == pytest.approx(3.0, abs=0.3)
    second = confirm(session, most_mm=2.0)
    assert second.kind is LearningEventKind.ZERO_NEEDED
    assert second.figures["distance_mm"] == pytest.approx(3.0, abs=0.3)
    status = session.pipeline.learner.status
    assert not status.has_reference
    assert status.reference_distance is None
    lie(session, lowered(still, 3.0), BREATH)
    assert confirm(session, most_mm=None).kind is LearningEventKind.REFERENCE_SET
    assert session.pipeline.learner.status.reference_distance.distance_mm == pytest.approx(3.0, abs=0.3)


def test_a_lower_level_of_the_same_position_counts_too(confirmed):
    """The end of inhale of a patient who has not moved is another reference."""
    found = distance(confirmed[0], INHALE)
    levels = {one.choice.label: one.level for one in found.levels}
    assert levels["whole"] == pytest.approx(5.6, abs=0.3)
    assert levels["volume"] == pytest.approx(0.55, abs=0.05)
    assert found.distance_mm >= max(levels["whole"], levels["abdomen"], 10.0 * levels["volume"])
    assert [one.choice for one in found.levels] == list(SETTINGS.breath_signals)


TURNED = cv2.Rodrigues(np.deg2rad([0.0, 0.0, 1.5]))[0]
TILTED = cv2.Rodrigues(np.deg2rad([1.0, 0.0, 0.0]))[0]
STILL = np.eye(3)


@pytest.mark.parametrize(
    ("rotation", "shift_mm", "expected"),
    [
        (STILL, (0.0, 0.0, 3.0), {"height_mm": -3.0, "moved_mm": 3.0}),
        (STILL, (3.0, -4.0, 0.0), {"shift_mm": 5.0, "moved_mm": 5.0}),
        (TURNED, (0.0, 0.0, 0.0), {"turn_deg": 1.5}),
        (TILTED, (0.0, 0.0, 0.0), {"tilt_deg": 1.0}),
    ],
    ids=["lowered", "shifted", "turned", "tilted"],
)
def test_shift_height_turn_and_tilt_are_reported_apart(confirmed, rotation, shift_mm, expected):
    learner = confirmed[0].pipeline.learner
    reference = learner.learned.reference
    middle_mm = reference.surface_mm.mean(axis=0)
    surface_mm = (reference.surface_mm - middle_mm) @ rotation.T + middle_mm + np.array(shift_mm)
    found = learner.history.distance(learner.active, replace(reference, surface_mm=surface_mm))
    for name in ("height_mm", "shift_mm", "turn_deg", "tilt_deg", "shape_mm"):
        assert getattr(found, name) == pytest.approx(expected.get(name, 0.0), abs=0.05), name
    assert found.moved_mm == pytest.approx(expected.get("moved_mm", found.moved_mm), abs=0.05)
    assert found.distance_mm >= found.moved_mm > 1.0


def test_a_surface_of_another_shape_is_reported_as_that(confirmed):
    learner = confirmed[0].pipeline.learner
    reference = learner.learned.reference
    bulge_mm = np.zeros_like(reference.surface_mm)
    bulge_mm[:: NODE_COLUMNS // 2, 2] = -8.0
    found = learner.history.distance(learner.active, replace(reference, surface_mm=reference.surface_mm + bulge_mm))
    assert found.shape_mm > 2.0
    assert found.distance_mm >= found.shape_mm


def again_in(first, frames):
    """A later session of the fraction, in which the patient lies as in these frames."""
    session = SceneSession(frames)
    session.pipeline.learner.history.restore(read_first_reference(first.to_json()))
    session.measure(760)
    return session


def test_after_a_restart_the_first_reference_of_the_fraction_still_counts(confirmed, still):
    session = again_in(confirmed[1].first, lowered(still, 3.0))
    notice = confirm(session, most_mm=2.0)
    assert notice.kind is LearningEventKind.ZERO_NEEDED
    assert notice.first is None
    assert notice.figures["distance_mm"] == pytest.approx(3.0, abs=0.4)
    lie(session, still)
    assert distance(session).distance_mm < 0.4
    assert confirm(session, most_mm=2.0).kind is LearningEventKind.REFERENCE_SET


def test_another_model_measures_the_same_distance(session):
    generation = session.pipeline.learner.journal.generation
    session.pipeline.learner.retrain(keeps_reference=False)
    while session.pipeline.learner.journal.generation == generation:
        session.measure(1)
    session.measure(SETTLED)
    assert not session.pipeline.learner.status.has_reference
    assert distance(session).distance_mm < 0.4


def test_a_model_that_takes_the_reference_over_takes_the_first_over(session, still):
    lie(session, lowered(still, 1.5))
    before = distance(session)
    generation = session.pipeline.learner.journal.generation
    session.pipeline.learner.retrain()
    while session.pipeline.learner.journal.generation == generation:
        session.measure(1)
    session.measure(SETTLED)
    assert distance(session).distance_mm == pytest.approx(before.distance_mm, abs=0.2)


def test_the_present_position_is_that_of_the_newest_frame(session, still):
    lie(session, lowered(still, 3.0), 1)
    before = distance(session, NOW)
    lie(session, lowered(still, 6.0), 1)
    after = distance(session, NOW)
    assert after.height_mm - before.height_mm == pytest.approx(-3.0, abs=0.5)


def test_a_patient_who_moves_between_the_request_and_the_next_measured_frame_is_not_taken_up(session, still):
    while distance(session, NOW).distance_mm > 1.0:
        session.measure(1)
    session.pipeline.learner.set_reference(NOW, most_mm=2.0)
    session.next(color=0 * session.frames[0].color)
    lie(session, lowered(still, 4.0), 2)
    assert not session.pipeline.learner.status.has_reference
    assert session.pipeline.learner.take_notices()[-1].kind is LearningEventKind.ZERO_NEEDED


@pytest.mark.parametrize("moment", [NOW, EXHALE])
def test_a_reference_that_no_frame_takes_up_for_a_second_is_dropped(session, moment):
    """The patient behind the gap may lie elsewhere: the present position is no longer the one that was meant."""
    session.pipeline.learner.set_reference(moment)
    number = session.pipeline.learner.status.reference_number
    for _ in range(1_200_000 // small_scene.FRAME_US):
        session.next(color=0 * session.frames[0].color)
    session.measure(2)
    assert session.pipeline.learner.status.reference_number == number
    assert not session.pipeline.learner.status.has_reference
    assert session.pipeline.learner.take_notices()[-1].kind is LearningEventKind.ZERO_NEEDED


def test_while_the_patient_is_not_measured_the_distance_is_not_known(session):
    for _ in range(40):
        session.next(color=0 * session.frames[0].color)
    assert distance(session, NOW).unknown == reference_history.NOT_MEASURED


def test_after_the_camera_was_away_the_distance_is_not_known(session):
    session.pipeline.camera_returned()
    session.measure(760)
    assert distance(session).unknown == reference_history.AWAY
    assert confirm(session, most_mm=2.0).kind is LearningEventKind.ZERO_NEEDED
    session.measure(BREATH)
    assert confirm(session).kind is LearningEventKind.REFERENCE_SET


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({"calibration_sha256": "0" * 64}, reference_history.OTHER_CAMERA),
        ({"layout_sha256": "0" * 64}, reference_history.OTHER_REGIONS),
    ],
)
def test_another_camera_or_other_regions_are_not_compared(confirmed, unconfirmed, other, reason):
    session = copied(unconfirmed)
    session.pipeline.learner.history.restore(replace(confirmed[1].first, **other))
    assert distance(session).unknown == reason
    assert distance(session).distance_mm is None


# -- the document ---------------------------------------------------------------------------------------------------


def test_the_document_holds_the_position(confirmed):
    first = read_first_reference(confirmed[1].first.to_json())
    again = read_first_reference(first.to_json())
    assert np.abs(first.surface_mm - confirmed[1].first.surface_mm).max() < 1e-4
    assert again.calibration_sha256 == small_scene.CALIBRATION.sha256
    assert np.array_equal(again.surface_mm, first.surface_mm)
    assert np.array_equal(again.regions_mm, first.regions_mm, equal_nan=True)
    assert (again.plane_mm, again.volume_l) == (first.plane_mm, first.volume_l)


@pytest.mark.parametrize(
    ("damage", "field"),
    [
        (("{", "["), "file"),
        ((SCHEMA, "tidegate.first-reference/9"), "schema"),
        (('"plane_mm"', '"plain_mm"'), "plain_mm"),
        (('"volume_l": ', '"volume_l": 1e9, "x": '), "x"),
        (('"regions_mm": [', '"regions_mm": [1e99, '), "regions_mm[0]"),
        (('"surface_mm": [', '"surface_mm": [1.0, '), "surface_mm"),
    ],
)
def test_a_damaged_document_is_refused_by_field(confirmed, damage, field):
    text = confirmed[1].first.to_json()
    with pytest.raises(InvalidValueError) as refusal:
        read_first_reference(text.replace(*damage))
    assert refusal.value.field == field
