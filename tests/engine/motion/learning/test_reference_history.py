"""The first reference of a fraction is kept; later ones state how far they lie from it, over models and restarts."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from engine.core.first_reference import SCHEMA, read_first_reference
from engine.core.learning_events import LearningEventKind
from engine.core.reference_proposal import ReferenceMoment
from engine.motion.learning import reference_history
from tests.support.motion import small_scene
from tests.support.motion.scene_session import SETTINGS, SceneSession, scene_frames

EXHALE, INHALE, NOW = ReferenceMoment
BREATH = 120
SETTLED = 5 * BREATH
"""Frames after which only breaths of the new position are proposed."""
MIDDLE_PX = (320.0, 240.0)


@pytest.fixture(scope="module")
def still():
    return scene_frames()


def moved(frames, *, lower_mm=0.0, tilt_deg=0.0, turn_deg=0.0, right_px=0.0):
    """The scene with a patient who lies lower, tilted about the axis across, turned, or further to the right."""
    turn = cv2.getRotationMatrix2D(MIDDLE_PX, -turn_deg, 1.0)
    turn[0, 2] += right_px
    slope_mm = np.tan(np.deg2rad(tilt_deg)) * (np.mgrid[0:480, 0:640][0] - 245.0) * 850.0 / 550.0

    def shown(frame):
        depth = frame.depth_mm.astype(np.float32)
        color = frame.color
        if turn_deg or right_px:
            depth = cv2.warpAffine(depth, turn, (640, 480), borderMode=cv2.BORDER_REPLICATE)
            color = cv2.warpAffine(color, turn, (640, 480), borderMode=cv2.BORDER_REPLICATE)
        depth = np.rint(depth + lower_mm - slope_mm).astype(np.uint16)
        return replace(frame, depth_mm=depth, color=color)

    return [shown(frame) for frame in frames]


@pytest.fixture
def session(still):
    session = SceneSession(still)
    session.measure(760)
    confirm(session)
    return session


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


def test_only_a_confirmed_reference_is_the_first(still):
    session = SceneSession(still)
    session.measure(760)
    assert session.pipeline.learner.learned.reference is not None
    assert distance(session) is None
    notice = confirm(session)
    assert notice.first is not None
    assert "first reference of this fraction" in notice.detail
    assert distance(session).distance_mm < 0.1
    assert confirm(session).first is None


def test_small_steps_add_up_and_the_one_beyond_the_budget_is_dropped(session, still):
    lie(session, moved(still, lower_mm=1.5))
    first = confirm(session, most_mm=2.0)
    assert first.kind is LearningEventKind.REFERENCE_SET
    assert first.figures["distance_mm"] == pytest.approx(1.5, abs=0.25)
    lie(session, moved(still, lower_mm=3.0))
    assert distance(session).distance_mm == pytest.approx(3.0, abs=0.3)
    second = confirm(session, most_mm=2.0)
    assert second.kind is LearningEventKind.ZERO_NEEDED
    assert second.figures["distance_mm"] == pytest.approx(3.0, abs=0.3)
    status = session.pipeline.learner.status
    assert not status.has_reference
    assert status.reference_distance is None
    lie(session, moved(still, lower_mm=3.0), BREATH)
    assert confirm(session, most_mm=None).kind is LearningEventKind.REFERENCE_SET
    assert session.pipeline.learner.status.reference_distance.distance_mm == pytest.approx(3.0, abs=0.3)


def test_a_lower_level_of_the_same_position_counts_too(session):
    """The end of inhale of a patient who has not moved is another reference."""
    found = distance(session, INHALE)
    levels = {one.choice.label: one.level for one in found.levels}
    assert levels["whole"] == pytest.approx(5.6, abs=0.3)
    assert levels["volume"] == pytest.approx(0.55, abs=0.05)
    assert found.distance_mm >= max(levels["whole"], levels["abdomen"], 10.0 * levels["volume"])
    assert [one.choice for one in found.levels] == list(SETTINGS.breath_signals)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"lower_mm": 3.0}, {"height_mm": (-3.0, 0.3), "shift_mm": (0.0, 0.3), "turn_deg": (0.0, 0.2)}),
        ({"right_px": 4.0}, {"shift_mm": (6.2, 0.5), "height_mm": (0.0, 0.5), "turn_deg": (0.0, 0.2)}),
        ({"turn_deg": 1.5}, {"turn_deg": (1.5, 0.2), "tilt_deg": (0.0, 0.3), "shift_mm": (0.0, 0.5)}),
        ({"tilt_deg": 1.0}, {"tilt_deg": (1.0, 0.2), "turn_deg": (0.0, 0.2), "shift_mm": (0.0, 0.5)}),
    ],
)
def test_shift_height_turn_and_tilt_are_told_apart(still, session, change, expected):
    first = session.pipeline.learner.learned.reference
    document = confirmed_document(still)
    other = SceneSession(moved(still, **change))
    other.pipeline.learner.continue_fraction(document)
    other.measure(760)
    found = distance(other)
    assert first is not None
    for name, (value, tolerance) in expected.items():
        assert getattr(found, name) == pytest.approx(value, abs=tolerance), name
    assert found.distance_mm > 1.0


DOCUMENTS = {}


def confirmed_document(still):
    """The first reference of a session that is over, through its document; learned once."""
    if "text" not in DOCUMENTS:
        session = SceneSession(still)
        session.measure(760)
        DOCUMENTS["text"] = confirm(session).first.to_json()
    return read_first_reference(DOCUMENTS["text"])


def test_after_a_restart_the_first_reference_of_the_fraction_still_counts(still):
    again = SceneSession(still)
    again.pipeline.learner.continue_fraction(confirmed_document(still))
    again.measure(760)
    assert distance(again).distance_mm < 0.4
    lowered = SceneSession(moved(still, lower_mm=3.0))
    lowered.pipeline.learner.continue_fraction(confirmed_document(still))
    lowered.measure(760)
    notice = confirm(lowered, most_mm=2.0)
    assert notice.kind is LearningEventKind.ZERO_NEEDED
    assert notice.first is None
    assert notice.figures["distance_mm"] == pytest.approx(3.0, abs=0.4)


def test_another_model_measures_the_same_distance(session):
    generation = session.pipeline.learner.generation
    session.pipeline.learner.retrain(keeps_zero=False)
    while session.pipeline.learner.generation == generation:
        session.measure(1)
    session.measure(SETTLED)
    assert not session.pipeline.learner.status.has_reference
    assert distance(session).distance_mm < 0.4


def test_a_model_that_takes_the_reference_over_takes_the_first_over(session, still):
    lie(session, moved(still, lower_mm=1.5))
    before = distance(session)
    generation = session.pipeline.learner.generation
    session.pipeline.learner.retrain()
    while session.pipeline.learner.generation == generation:
        session.measure(1)
    session.measure(SETTLED)
    assert distance(session).distance_mm == pytest.approx(before.distance_mm, abs=0.2)


def test_the_present_position_is_that_of_the_newest_frame(session, still):
    lie(session, moved(still, lower_mm=3.0), 1)
    before = distance(session, NOW)
    lie(session, moved(still, lower_mm=6.0), 1)
    after = distance(session, NOW)
    assert after.height_mm - before.height_mm == pytest.approx(-3.0, abs=0.5)


def test_a_patient_who_moves_between_the_request_and_the_next_measured_frame_is_not_taken_up(session, still):
    while distance(session, NOW).distance_mm > 1.0:
        session.measure(1)
    session.pipeline.learner.set_reference(NOW, most_mm=2.0)
    session.next(color=0 * session.frames[0].color)
    lie(session, moved(still, lower_mm=4.0), 2)
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
def test_another_camera_or_other_regions_are_not_compared(still, other, reason):
    session = SceneSession(still)
    session.pipeline.learner.continue_fraction(replace(confirmed_document(still), **other))
    session.measure(760)
    assert distance(session).unknown == reason
    assert distance(session).distance_mm is None


# -- the document ---------------------------------------------------------------------------------------------------


def test_the_document_holds_the_position(still):
    first = confirmed_document(still)
    again = read_first_reference(first.to_json())
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
def test_a_damaged_document_is_refused_by_field(still, damage, field):
    text = confirmed_document(still).to_json()
    with pytest.raises(InvalidValueError) as refusal:
        read_first_reference(text.replace(*damage))
    assert refusal.value.field == field
