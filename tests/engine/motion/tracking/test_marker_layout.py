"""A marker that is not where it was relative to the others is lost with its name, until it is back or confirmed."""

import numpy as np
import pytest

from engine.core.frames import ROI_COLUMNS, ROI_ROWS, LostReason, RoiDepth
from engine.motion.stages.markers import CORNERS
from engine.motion.tracking.surface_continuity import (
    MARGIN_MM,
    MAX_HIDDEN_US,
    MarkerLayout,
    distances_mm,
    marker_points_mm,
)

FRAME_US = 33_333
POINTS_MM = np.array([[-110.0, -150.0, 860.0], [110.0, -150.0, 860.0], [100.0, 160.0, 850.0], [-100.0, 160.0, 850.0]])


def breathing(frame, depth_mm=8.0):
    """The markers while the abdomen rises more than the thorax, and the skin stretches a little."""
    share = 0.5 - 0.5 * np.cos(frame / 20.0)
    lifted = POINTS_MM * np.array([1.0 + 0.01 * share, 1.0, 1.0])
    lifted[:, 2] -= share * depth_mm * np.array([0.3, 0.3, 1.0, 1.0])
    return lifted


def moved(points_mm, marker, by_mm):
    changed = points_mm.copy()
    outward = changed[marker, :2] - changed[:, :2].mean(axis=0)
    changed[marker, :2] += by_mm * outward / np.hypot(*outward)
    return changed


def at(frame):
    return frame * FRAME_US


@pytest.fixture
def followed():
    """A layout that was followed over some breaths; and the next frame."""
    layout = MarkerLayout()
    layout.restart(1)
    for frame in range(300):
        assert layout.lost(breathing(frame), at(frame)) is None
    return layout, 300


@pytest.mark.parametrize("marker", range(4))
@pytest.mark.parametrize("by_mm", [8.0, 15.0, -15.0])
def test_a_marker_that_is_back_elsewhere_is_named_and_stays_lost(followed, marker, by_mm):
    layout, frame = followed
    frame += 25
    for later in range(frame, frame + 90):
        lost = layout.lost(moved(breathing(later), marker, by_mm), at(later))
        assert lost is not None
        assert lost.reason is LostReason.LAYOUT_CHANGED
        assert CORNERS[marker] in lost.detail
    assert layout.lost(breathing(frame + 90), at(frame + 90)) is None, "it was put back"


def test_markers_that_were_hidden_and_are_where_they_were_are_accepted_at_any_phase(followed):
    layout, frame = followed
    for hidden in (10, 31, 77, 400):
        frame += hidden
        assert layout.lost(breathing(frame), at(frame)) is None


@pytest.mark.parametrize("towards_mm", [8.0, -8.0])
def test_the_range_widens_both_ways_while_the_markers_are_followed(followed, towards_mm):
    layout, frame = followed
    for step in range(41):
        assert layout.lost(moved(breathing(frame), 2, towards_mm * step / 40.0), at(frame + step)) is None
    for step in range(41):
        assert layout.lost(moved(breathing(frame), 2, towards_mm * (1.0 - step / 40.0)), at(frame + 41 + step)) is None
    assert layout.lost(moved(breathing(frame), 2, towards_mm), at(frame + 200)) is None


def test_a_whole_patient_who_moved_keeps_the_layout(followed):
    layout, frame = followed
    cos, sin = np.cos(np.deg2rad(20.0)), np.sin(np.deg2rad(20.0))
    turned = breathing(frame) @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    assert layout.lost(turned + np.array([30.0, -20.0, 15.0]), at(frame + 50)) is None


def test_skin_that_stretches_slowly_is_followed_and_a_jump_between_two_frames_is_not(followed):
    layout, frame = followed
    for step in range(60):
        assert layout.lost(moved(POINTS_MM, 2, 0.2 * step), at(frame + step)) is None
    assert layout.lost(moved(POINTS_MM, 2, 12.0 + 2.0 * MARGIN_MM), at(frame + 60)) is not None


def test_an_interval_shorter_than_the_bound_is_followed_and_a_longer_one_is_compared_with_the_range(followed):
    layout, frame = followed
    for step in range(60):  # the range grows to 12 mm, and the marker stays there
        layout.lost(moved(POINTS_MM, 2, 0.2 * step), at(frame + step))
    last_us = at(frame + 59)
    short = MarkerLayout()
    short.__dict__.update(layout.__dict__)
    assert short.lost(POINTS_MM, last_us + MAX_HIDDEN_US) is not None, "12 mm within a few frames"
    assert layout.lost(POINTS_MM, last_us + MAX_HIDDEN_US + 1) is None, "it had been there before"


def test_a_person_who_sets_the_reference_or_a_new_model_confirms_the_layout(followed):
    layout, frame = followed
    elsewhere = moved(breathing(frame), 1, 20.0)
    assert layout.lost(elsewhere, at(frame + 30)) is not None
    layout.restart(1)
    assert layout.lost(elsewhere, at(frame + 31)) is not None
    layout.restart(2)
    assert layout.lost(elsewhere, at(frame + 32)) is None


def test_places_that_are_unknown_or_no_numbers_are_not_followed(followed):
    layout, frame = followed
    assert layout.lost(None, at(frame)) is None
    assert layout.lost(np.full((4, 3), np.nan), at(frame + 1)) is not None


def region(stride_px):
    depth_mm = np.full((ROI_ROWS, ROI_COLUMNS), 800.0, dtype=np.float32)
    depth_mm[:175, :100], depth_mm[:175, 100:], depth_mm[175:, 100:], depth_mm[175:, :100] = 810.0, 820.0, 830.0, 840.0
    valid = np.ones_like(depth_mm, dtype=np.bool_)
    return RoiDepth(depth_mm=depth_mm, valid=valid).thinned(stride_px)


@pytest.mark.parametrize("stride_px", [1, 2, 4])
def test_places_are_the_markers_rays_at_the_depth_beside_each(stride_px):
    rays = np.array([[-0.1, -0.2, 1.0], [0.1, -0.2, 1.0], [0.1, 0.2, 1.0], [-0.1, 0.2, 1.0]])
    points_mm = marker_points_mm(rays, region(stride_px))
    assert points_mm[:, 2].tolist() == [810.0, 820.0, 830.0, 840.0]
    assert np.allclose(points_mm[:, :2], rays[:, :2] * points_mm[:, 2:])


def test_a_marker_beside_which_nothing_is_seen_has_no_place():
    seen = region(4)
    valid = seen.valid.copy()
    valid[-5:, -5:] = False
    assert marker_points_mm(np.ones((4, 3)), RoiDepth(depth_mm=seen.depth_mm, valid=valid, stride_px=4)) is None


def test_distances_are_those_between_all_six_pairs():
    assert distances_mm(np.array([[0.0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0]])) == (3, 5, 4, 4, 5, 3)


SQUARE_MM = np.array([[0.0, 0.0, 800.0], [100.0, 0.0, 800.0], [100.0, 100.0, 800.0], [0.0, 100.0, 800.0]])


def wide(by_mm):
    """The square with its superior left marker moved along the side between the superior two."""
    points_mm = SQUARE_MM.copy()
    points_mm[1, 0] += by_mm
    return points_mm


@pytest.mark.parametrize(("by_mm", "is_lost"), [(MARGIN_MM, False), (MARGIN_MM + 0.001, True)])
def test_a_distance_may_change_by_the_margin_itself(by_mm, is_lost):
    layout = MarkerLayout()
    layout.restart(1)
    assert layout.lost(SQUARE_MM, at(0)) is None
    assert (layout.lost(wide(by_mm), at(1)) is not None) is is_lost


def stretched():
    """A layout whose superior two markers went apart by 10 mm, a millimetre a frame; and the next frame."""
    layout = MarkerLayout()
    layout.restart(1)
    for frame in range(11):
        assert layout.lost(wide(float(frame)), at(frame)) is None
    return layout, 11


def test_after_a_doubt_the_next_frame_is_compared_with_the_range():
    layout, frame = stretched()
    assert layout.lost(wide(0.0), at(frame)) is not None, "a jump from one frame to the next"
    assert layout.lost(wide(0.0), at(frame + 1)) is None, "within the range of the breaths so far"
    assert layout.lost(wide(10.0), at(frame + 2)) is not None, "and followed again"


def test_a_loss_names_the_marker_its_largest_distance_and_what_to_do():
    layout, frame = stretched()
    assert layout.lost(wide(30.0), at(frame)).detail == (
        "a distance of the superior left marker is 20 mm beyond its range: put the marker back, or set the reference "
        "again"
    )


@pytest.mark.parametrize("scale", [1.02, 0.98])
def test_a_change_of_all_distances_by_one_factor_is_named_as_the_camera_s_scale(followed, scale):
    layout, frame = followed
    lost = layout.lost(scale * breathing(frame), at(frame))
    assert lost.reason is LostReason.LAYOUT_CHANGED
    assert f"all distances between the markers changed by {scale - 1.0:+.1%}" in lost.detail
    assert "check the camera" in lost.detail
