"""A surface that jumps is not skin: what comes to lie on the patient is lost, and stays so until it is gone."""

import numpy as np
import pytest

from engine.motion.tracking.surface_continuity import FRAME_US, MAX_STEP_MM, ObservedSurface, SurfaceContinuity

NODES = 135
BREATH = np.linspace(0.2, 1.0, NODES)[None]
REST_MM = np.full(NODES, 850.0)
MARKERS_PX = np.array([[240.0, 110.0], [400.0, 110.0], [395.0, 380.0], [245.0, 380.0]])
NOISE_MM = 5.0


def seen(depth_mm, frame, moved_px=0.0):
    return ObservedSurface(depth_mm=depth_mm, markers_px=MARKERS_PX + moved_px, timestamp_us=frame * FRAME_US)


def sheet(thickness_mm):
    depth = REST_MM.copy()
    depth[40:70] -= thickness_mm
    return depth


@pytest.fixture
def continuity():
    fresh = SurfaceContinuity()
    fresh.restart(1)
    assert not fresh.rejection(seen(REST_MM, 0), BREATH, NOISE_MM)
    return fresh


def test_breathing_and_a_cough_are_believed(continuity):
    depth = REST_MM
    for frame in range(1, 40):
        depth = depth - 1.6 * BREATH[0] * (1.0 if frame % 20 < 10 else -1.0)
        assert not continuity.rejection(seen(depth, frame), BREATH, NOISE_MM)


def test_a_sheet_is_doubted_for_as_long_as_it_lies_there_and_forgotten_when_it_is_gone(continuity):
    for frame in range(1, 60):
        breathing = sheet(4.0) - 3.0 * np.sin(frame / 10.0) * BREATH[0]
        assert continuity.rejection(seen(breathing, frame), BREATH, NOISE_MM)
    assert not continuity.rejection(seen(REST_MM - 6.0 * BREATH[0], 60), BREATH, NOISE_MM)
    assert continuity.rejection(seen(sheet(4.0), 61), BREATH, NOISE_MM)


def test_after_something_lay_in_the_view_only_the_same_shape_is_believed(continuity):
    continuity.interrupt()
    assert continuity.rejection(seen(sheet(3.0), 30), BREATH, NOISE_MM)
    assert not continuity.rejection(seen(REST_MM - 8.0 * BREATH[0], 31), BREATH, NOISE_MM)


def test_a_person_who_sets_the_reference_or_a_new_model_is_believed(continuity):
    assert continuity.rejection(seen(sheet(4.0), 1), BREATH, NOISE_MM)
    continuity.restart(1)
    assert continuity.rejection(seen(sheet(4.0), 2), BREATH, NOISE_MM)
    continuity.restart(2)
    assert not continuity.rejection(seen(sheet(4.0), 3), BREATH, NOISE_MM)


def test_a_sheet_over_one_side_is_no_patient_who_tilts(continuity):
    one_side = REST_MM.reshape(15, 9).copy()
    one_side[:, :5] -= 4.0
    assert continuity.rejection(seen(one_side.ravel(), 1), BREATH, NOISE_MM)


def test_a_patient_or_a_couch_that_moves_as_a_whole_is_followed_however_fast(continuity):
    tilt = np.repeat(np.linspace(-4.0, 4.0, 15), 9)
    assert not continuity.rejection(seen(REST_MM - 12.0 + tilt, 1), BREATH, NOISE_MM)
    continuity.interrupt()
    assert not continuity.rejection(seen(REST_MM + 9.0 - 5.0 * BREATH[0], 2), BREATH, NOISE_MM)


def test_a_patient_who_takes_the_markers_along_is_followed(continuity):
    assert not continuity.rejection(seen(sheet(9.0), 1, moved_px=8.0), BREATH, NOISE_MM)
    assert continuity.rejection(seen(sheet(18.0), 2, moved_px=9.0), BREATH, NOISE_MM)


def test_unseen_frames_allow_for_what_they_could_hide_but_not_for_everything(continuity):
    assert not continuity.rejection(seen(sheet(4.0), 4), BREATH, NOISE_MM)
    assert continuity.rejection(seen(sheet(14.0), 8), BREATH, NOISE_MM)


@pytest.mark.parametrize("missed", [4, 20, 400])
def test_more_than_three_unmeasured_frames_interrupt_continuity_whatever_the_reason(continuity, missed):
    """A sheet that was laid meanwhile stays lost, however slowly it could have come; the patient is measured again."""
    for frame in range(missed + 1, missed + 40):
        breathing = sheet(3.0) - 3.0 * np.sin(frame / 10.0) * BREATH[0]
        assert continuity.rejection(seen(breathing, frame), BREATH, NOISE_MM)
    assert not continuity.rejection(seen(REST_MM - 6.0 * BREATH[0], missed + 40), BREATH, NOISE_MM)


def test_a_noisier_sensor_is_allowed_more(continuity):
    step = sheet(1.3 * MAX_STEP_MM)
    assert continuity.rejection(seen(step, 1), BREATH, NOISE_MM)
    fresh = SurfaceContinuity()
    assert not fresh.rejection(seen(REST_MM, 0), BREATH, 12.0)
    assert not fresh.rejection(seen(step, 1), BREATH, 12.0)


def test_what_is_no_number_is_doubted(continuity):
    assert continuity.rejection(seen(np.full(NODES, np.nan), 1), BREATH, NOISE_MM)


def calm(seconds=2.0):
    """A patient who was believed for some seconds of quiet breathing; and the next frame's number."""
    fresh = SurfaceContinuity()
    fresh.restart(1)
    frames = round(seconds * 1e6 / FRAME_US)
    for frame in range(frames):
        assert not fresh.rejection(seen(REST_MM - 3.0 * np.sin(frame / 15.0) * BREATH[0], frame), BREATH, NOISE_MM)
    return fresh, frames


def cough(continuity, frame):
    """Bend the body in jumps, with a surface in their midst that follows from the one before it."""
    bent = [sheet(thickness_mm) for thickness_mm in (6.0, 11.0)]
    assert continuity.rejection(seen(bent[0], frame), BREATH, NOISE_MM)
    assert not continuity.rejection(seen(sheet(1.8), frame + 1), BREATH, NOISE_MM)
    assert not continuity.rejection(seen(sheet(3.4), frame + 2), BREATH, NOISE_MM)
    assert continuity.rejection(seen(bent[1], frame + 3), BREATH, NOISE_MM)
    return frame + 4


def test_after_a_cough_the_shape_of_the_calm_before_is_believed_again():
    continuity, frame = calm()
    frame = cough(continuity, frame)
    assert not continuity.rejection(seen(REST_MM - 2.0 * BREATH[0], frame), BREATH, NOISE_MM)
    assert not continuity.rejection(seen(REST_MM - 2.5 * BREATH[0], frame + 1), BREATH, NOISE_MM)


def test_without_a_second_of_calm_there_is_nothing_else_to_come_back_to():
    continuity, frame = calm(seconds=0.9)
    frame = cough(continuity, frame)
    assert continuity.rejection(seen(REST_MM, frame), BREATH, NOISE_MM)


def test_a_sheet_that_is_let_down_step_by_step_between_doubts_is_not_the_calm_before():
    continuity, frame = calm()
    frame = cough(continuity, frame)
    for _ in range(60):
        assert continuity.rejection(seen(sheet(6.0), frame), BREATH, NOISE_MM)
        frame += 1


def test_a_patient_who_moved_does_not_come_back_to_where_they_lay():
    continuity, frame = calm()
    assert not continuity.rejection(seen(sheet(9.0), frame, moved_px=8.0), BREATH, NOISE_MM)
    assert continuity.rejection(seen(sheet(20.0), frame + 1, moved_px=8.0), BREATH, NOISE_MM)
    assert continuity.rejection(seen(REST_MM, frame + 2, moved_px=8.0), BREATH, NOISE_MM)


def test_the_calm_of_another_reference_is_nothing_to_come_back_to():
    continuity, frame = calm()
    continuity.restart(2)
    assert not continuity.rejection(seen(sheet(9.0), frame), BREATH, NOISE_MM)
    assert continuity.rejection(seen(sheet(18.0), frame + 1), BREATH, NOISE_MM)
    assert continuity.rejection(seen(REST_MM, frame + 2), BREATH, NOISE_MM)


def test_a_second_of_calm_counts_from_where_the_patient_moved_to():
    continuity, frame = calm()
    assert not continuity.rejection(seen(sheet(9.0), frame, moved_px=8.0), BREATH, NOISE_MM)
    assert not continuity.rejection(seen(sheet(10.8), frame + 1, moved_px=8.0), BREATH, NOISE_MM)
    assert continuity.rejection(seen(sheet(16.0), frame + 2, moved_px=8.0), BREATH, NOISE_MM)
    for step, thickness_mm in enumerate((9.2, 7.6, 6.0), start=3):  # down again, each a little from the one before
        assert not continuity.rejection(seen(sheet(thickness_mm), frame + step, moved_px=8.0), BREATH, NOISE_MM)
    assert continuity.rejection(seen(sheet(1.0), frame + 6, moved_px=8.0), BREATH, NOISE_MM)
    assert continuity.rejection(seen(sheet(9.0), frame + 7, moved_px=8.0), BREATH, NOISE_MM)


CURVED = (0.2 + 0.8 * np.sin(np.linspace(0.0, np.pi, NODES)) ** 2)[None]
"""A breath whose shape no plane has."""


def rejected(continuity, depth_mm, frame, shapes=CURVED, moved_px=0.0):
    return continuity.rejection(seen(depth_mm, frame, moved_px), shapes, NOISE_MM)


@pytest.mark.parametrize("first", [0, 100])
def test_a_breath_of_one_frame_is_too_fast_and_after_an_occlusion_it_is_a_breath(first):
    for is_interrupted in (False, True):
        continuity = SurfaceContinuity()
        continuity.restart(1)
        assert not rejected(continuity, REST_MM, first)
        if is_interrupted:
            continuity.interrupt()
        found = rejected(continuity, REST_MM - 8.0 * CURVED[0], first + 1)
        assert (found == "") is is_interrupted
    assert not rejected(SurfaceContinuity(), REST_MM, 0)


def test_a_rejection_states_how_far_and_what_to_do(continuity):
    assert rejected(continuity, sheet(4.0), 1) == (
        "the surface changed by 4.0 mm, faster than skin can move: check for objects on the patient, then set the "
        "reference again"
    )


def test_an_occlusion_before_the_first_surface_interrupts_nothing():
    continuity = SurfaceContinuity()
    continuity.restart(1)
    continuity.interrupt()
    assert not rejected(continuity, REST_MM, 0)
    assert rejected(continuity, REST_MM - 8.0 * CURVED[0], 1)


def test_a_new_reference_after_a_doubt_is_followed_frame_by_frame(continuity):
    assert rejected(continuity, sheet(4.0), 1)
    continuity.restart(2)
    assert not rejected(continuity, sheet(4.0), 2)
    assert rejected(continuity, sheet(4.0) - 8.0 * CURVED[0], 3)


def test_a_sheet_is_no_return_to_the_calm_surface():
    continuity, frame = calm()
    frame = cough(continuity, frame)
    assert rejected(continuity, sheet(9.0), frame, BREATH)
    assert not rejected(continuity, REST_MM, frame + 1, BREATH)


@pytest.mark.parametrize("body_mm", [0.0, 30.0])
@pytest.mark.parametrize(("frames", "is_back"), [(25, True), (24, False)])
def test_a_surface_is_calm_after_a_second_itself(frames, is_back, body_mm):
    """25 periods of 40 ms of a body, flat or not; two steps of a sheet that each could be skin; then the body again."""
    continuity, no_breath = SurfaceContinuity(), np.empty((0, NODES))
    continuity.restart(1)
    for frame in range(frames + 1):
        assert not rejected(continuity, sheet(body_mm), frame, BREATH)
    for number, thickness_mm in enumerate((1.9, 3.8), start=1):
        continuity.interrupt()
        assert not rejected(continuity, sheet(body_mm + thickness_mm), frame + number, no_breath)
    continuity.interrupt()
    assert (rejected(continuity, sheet(body_mm), frame + 3, no_breath) == "") is is_back


@pytest.mark.parametrize(("moved_px", "is_followed"), [(5.0, False), (5.001, True)])
def test_markers_have_moved_beyond_their_bound_itself(continuity, moved_px, is_followed):
    assert (rejected(continuity, sheet(9.0), 1, moved_px=moved_px) == "") is is_followed


@pytest.mark.parametrize(("thickness_mm", "is_accepted"), [(2.0, True), (2.001, False)])
def test_a_change_that_equals_its_bound_is_accepted_after_an_occlusion_too(continuity, thickness_mm, is_accepted):
    continuity.interrupt()
    assert (rejected(continuity, sheet(thickness_mm), 1, np.empty((0, NODES))) == "") is is_accepted


@pytest.mark.parametrize(("bump_mm", "is_accepted"), [(1.0, True), (4.0, False)])
def test_a_patient_who_moves_as_a_whole_may_bend_a_little(continuity, bump_mm, is_accepted):
    assert (rejected(continuity, sheet(bump_mm) - 12.0, 1) == "") is is_accepted
