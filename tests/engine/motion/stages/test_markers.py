"""Markers are found to a tenth of a pixel, ordered by geometry, and nothing else is taken for one."""

import cv2
import numpy as np
import pytest

from engine.core.frames import Lost, LostReason, Markers
from engine.motion.stages.markers import (
    MarkerSearch,
    find_markers,
    layout_change,
    order_by_geometry,
    track_markers,
)

DIAMETER_PX = 13.0
SEARCH = MarkerSearch(diameter_px=DIAMETER_PX)
CORNERS = np.array([[240.3, 120.7], [402.6, 124.2], [392.1, 384.9], [246.8, 380.4]])
SUPERSAMPLING = 8


def draw_disc(picture, center, diameter, level):
    """Draw an anti-aliased ellipse-free disc whose centre is exact to a hundredth of a pixel."""
    reach = int(diameter) + 2
    left, top = int(center[0]) - reach, int(center[1]) - reach
    span = (np.arange((2 * reach + 1) * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5
    x, y = np.meshgrid(left + span, top + span)
    inside = (np.hypot(x - center[0], y - center[1]) <= diameter / 2).astype(np.float32)
    share = inside.reshape(2 * reach + 1, SUPERSAMPLING, 2 * reach + 1, SUPERSAMPLING).mean(axis=(1, 3))
    window = picture[top : top + 2 * reach + 1, left : left + 2 * reach + 1]
    window += (level - window) * share[:, :, None]


def scene(corners=CORNERS, seed=0, distractors=True):
    """A dark shirt on a bright bed under uneven light, skin, a lamp, a button, blur, noise and JPEG."""
    rng = np.random.default_rng(seed)
    picture = np.full((480, 640, 3), 205.0, dtype=np.float32)
    cv2.ellipse(picture, (320, 250), (140, 200), 0, 0, 360, (42.0, 40.0, 44.0), -1)
    cv2.ellipse(picture, (320, 30), (60, 50), 0, 0, 360, (210.0, 160.0, 130.0), -1)
    for center in corners:
        draw_disc(picture, center, DIAMETER_PX, 225.0)
    if distractors:
        draw_disc(picture, (330.0, 250.0), 4.0, 250.0)
        draw_disc(picture, (300.0, 200.0), 34.0, 250.0)
        cv2.rectangle(picture, (350, 300), (380, 304), (250.0, 250.0, 250.0), -1)
        draw_disc(picture, (90.0, 400.0), DIAMETER_PX, 250.0)
    light = np.linspace(1.0, 0.72, 640, dtype=np.float32)[None, :, None]
    picture = cv2.GaussianBlur(picture * light, (0, 0), 0.9)
    picture += rng.normal(0.0, 2.5, picture.shape).astype(np.float32)
    rgb = np.clip(picture, 0, 255).astype(np.uint8)
    _, jpeg = cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, 92])
    return cv2.imdecode(jpeg, cv2.IMREAD_COLOR)


@pytest.mark.parametrize("seed", range(6))
def test_centres_are_found_to_a_tenth_of_a_pixel(seed):
    corners = CORNERS + np.random.default_rng(seed).uniform(-3.0, 3.0, (4, 2))
    found = find_markers(scene(corners, seed), SEARCH)
    assert isinstance(found, Markers)
    assert np.abs(found.centers_px - corners).max() < 0.1


def test_stickers_on_a_slope_are_found_where_they_are():
    picture = np.full((480, 640, 3), 42.0, dtype=np.float32)
    for (x, y), angle in zip(CORNERS, (30.0, -40.0, 10.0, 80.0), strict=True):
        center = (round(x * 16), round(y * 16))
        axes = (round(6.5 * 16), round(0.6 * 6.5 * 16))
        cv2.ellipse(picture, center, axes, angle, 0, 360, (225.0, 225.0, 225.0), -1, cv2.LINE_AA, 4)
    found = find_markers(cv2.GaussianBlur(picture, (0, 0), 0.9).astype(np.uint8), SEARCH)
    assert isinstance(found, Markers)
    assert np.abs(found.centers_px - CORNERS).max() < 0.15


def test_tracking_finds_the_same_centres_as_searching():
    picture = scene()
    searched = find_markers(picture, SEARCH)
    tracked = track_markers(picture, CORNERS + 3.0, SEARCH)
    assert isinstance(searched, Markers)
    assert isinstance(tracked, Markers)
    assert np.abs(tracked.centers_px - searched.centers_px).max() < 0.02


@pytest.mark.parametrize("hidden", range(4))
def test_a_hidden_marker_is_lost_not_replaced_by_something_else(hidden):
    corners = np.delete(CORNERS, hidden, axis=0)
    picture = scene(corners)
    tracked = track_markers(picture, CORNERS, SEARCH)
    assert isinstance(tracked, Lost)
    names = ("superior right", "superior left", "inferior left", "inferior right")
    assert tracked.detail == f"the {names[hidden]} marker is hidden or gone"
    found = find_markers(picture, SEARCH)
    assert isinstance(found, Lost)
    assert found.reason is LostReason.MARKER_LOST


@pytest.mark.parametrize("angle_deg", [-40, -20, 0, 20, 40])
def test_the_order_follows_the_patient_not_the_order_found(angle_deg):
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = (CORNERS - 300.0) @ turn.T
    superior = tuple(turn @ np.array([0.0, -1.0]))
    for shuffle in np.random.default_rng(1).permuted(np.tile(np.arange(4), (6, 1)), axis=1):
        assert np.allclose(order_by_geometry(turned[shuffle], superior), turned)


def test_a_patient_lying_across_the_picture_is_taken_to_lie_with_the_head_to_its_left():
    picture = np.full((480, 640, 3), 42.0, dtype=np.float32)
    across = np.array([[180.0, 330.0], [182.0, 170.0], [450.0, 175.0], [446.0, 325.0]])
    for center in across:
        draw_disc(picture, center, DIAMETER_PX, 225.0)
    rgb = cv2.GaussianBlur(picture, (0, 0), 0.9).astype(np.uint8)
    found = find_markers(rgb, SEARCH)
    assert isinstance(found, Markers)
    assert np.abs(found.centers_px - across).max() < 0.1
    reported = find_markers(rgb, MarkerSearch(diameter_px=DIAMETER_PX, superior_px=(1.0, 0.0)))
    assert isinstance(reported, Markers)
    assert np.abs(reported.centers_px - across[[2, 3, 0, 1]]).max() < 0.1


def test_an_empty_and_a_white_picture_hold_no_markers():
    for level in (0, 255):
        assert isinstance(find_markers(np.full((480, 640, 3), level, np.uint8), SEARCH), Lost)


def test_a_marker_at_the_picture_edge_is_lost_not_an_error():
    near_edge = CORNERS.copy()
    near_edge[0] = (2.0, 3.0)
    assert isinstance(track_markers(scene(), near_edge, SEARCH), Lost)


def test_layout_change_sees_one_moved_marker_and_not_a_moved_patient():
    moved = CORNERS.copy()
    moved[2] += (0.0, 30.0)
    assert layout_change(moved, CORNERS) > 0.08
    assert layout_change(CORNERS + 25.0, CORNERS) < 1e-12
