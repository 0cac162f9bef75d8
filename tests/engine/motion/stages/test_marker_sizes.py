"""Whatever size a marker is expected to have, and whatever the picture shows, the search answers and never raises."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from engine.core.frames import Lost, LostReason, Markers
from engine.motion.stages import markers as marker_stage
from engine.motion.stages.markers import (
    LARGEST_SHARE,
    RADIUS_STEP_PX,
    SMALLEST_PX,
    MarkerSearch,
    find_markers,
    find_stickers,
    track_markers,
)

ROWS, COLUMNS = 120, 160
LARGEST_PX = LARGEST_SHARE * ROWS
EVERY_STEP_PX = [2.0 * RADIUS_STEP_PX * step for step in range(1, round(0.5 * LARGEST_PX / RADIUS_STEP_PX) + 20)]
SHIRT = (42, 40, 44)


def picture_of(centers_px, diameter_px, shape=(ROWS, COLUMNS)):
    picture = np.full((*shape, 3), SHIRT, np.uint8)
    for x, y in centers_px:
        middle, radius = (round(x * 16), round(y * 16)), round(diameter_px * 8)
        cv2.circle(picture, middle, radius, (225, 225, 225), -1, cv2.LINE_AA, shift=4)
    return cv2.GaussianBlur(picture, (0, 0), 0.6)


def corners_px(diameter_px):
    """A square as small as four stickers may stand in, in the middle of the picture."""
    half_px = 2.05 * diameter_px
    return np.array([COLUMNS / 2, ROWS / 2]) + half_px * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


def is_findable(diameter_px):
    return SMALLEST_PX <= diameter_px <= LARGEST_PX


@pytest.mark.parametrize("level", [0, 255, "noise", "stickers"])
def test_at_every_stencil_step_a_search_answers(level):
    rng = np.random.default_rng(1)
    for diameter_px in EVERY_STEP_PX:
        corners = corners_px(min(diameter_px, LARGEST_PX))
        if level == "stickers":
            picture = picture_of(corners, diameter_px)
        elif level == "noise":
            picture = rng.integers(0, 256, (ROWS, COLUMNS, 3), np.uint8)
        else:
            picture = np.full((ROWS, COLUMNS, 3), level, np.uint8)
        search = MarkerSearch(diameter_px=diameter_px)
        outcomes = find_markers(picture, search), track_markers(picture, corners, search)
        if not is_findable(diameter_px):
            assert all(isinstance(outcome, Lost) and "px wide" in outcome.detail for outcome in outcomes)
            assert len(find_stickers(picture, search)) == 0


def test_every_stencil_that_is_used_has_a_ring_to_compare_its_disc_with():
    steps = [round(0.5 * size / RADIUS_STEP_PX) for size in EVERY_STEP_PX if is_findable(size)]
    assert min(steps) == 16
    for step in steps:
        stencil = marker_stage._stencil(step)
        assert len(stencil.ring) >= 8
        assert len(stencil.disc) >= 1


@pytest.mark.parametrize("diameter_px", [1.01 * SMALLEST_PX, 6.0, 13.0, 0.95 * LARGEST_PX])
def test_the_smallest_and_the_largest_stickers_are_found_where_they_are(diameter_px):
    corners = corners_px(diameter_px)
    found = find_markers(picture_of(corners, diameter_px), MarkerSearch(diameter_px=diameter_px))
    assert isinstance(found, Markers)
    assert np.abs(found.centers_px - corners).max() < 0.15


@given(
    diameter_px=st.floats(allow_nan=True, allow_infinity=True) | st.floats(0.0, 40.0),
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(2, 64), st.integers(2, 64)),
)
@example(diameter_px=2.6, seed=0, shape=(64, 64))
@example(diameter_px=1e5, seed=0, shape=(64, 64))
@settings(max_examples=150, deadline=None)
def test_no_size_and_no_picture_makes_the_search_raise(diameter_px, seed, shape):
    rng = np.random.default_rng(seed)
    picture = rng.choice(rng.integers(0, 256, rng.integers(1, 5)), (*shape, 3)).astype(np.uint8)
    search = MarkerSearch(diameter_px=diameter_px)
    expected = rng.uniform(-10.0, 80.0, (4, 2))
    for outcome in (find_markers(picture, search), track_markers(picture, expected, search)):
        if isinstance(outcome, Lost):
            assert outcome.reason is LostReason.MARKER_LOST
        else:
            assert np.isfinite(outcome.centers_px).all()
    assert np.isfinite(find_stickers(picture, search)).all()


@pytest.mark.parametrize("diameter_px", [math.nan, 0.0, -3.0, 2.6, math.nextafter(SMALLEST_PX, 0.0), 21.0, math.inf])
def test_a_size_that_cannot_be_is_lost_with_the_size_and_its_bounds(diameter_px):
    outcome = find_markers(picture_of(corners_px(10.0), 10.0), MarkerSearch(diameter_px=diameter_px))
    assert isinstance(outcome, Lost)
    assert outcome.reason is LostReason.MARKER_LOST
    assert "3.2 to 20 px" in outcome.detail


@pytest.mark.parametrize("kind", ["on a line", "one inside of the others", "crossed"])
def test_markers_that_come_to_bound_no_region_are_lost_while_they_are_tracked(kind):
    layouts = {
        "on a line": [(20, 60), (60, 60), (100, 60), (140, 60)],
        "one inside of the others": [(20, 20), (140, 20), (80, 40), (80, 110)],
        "crossed": [(20, 20), (140, 100), (140, 20), (20, 100)],
    }
    centers = np.array(layouts[kind], dtype=np.float64)
    outcome = track_markers(picture_of(centers, 8.0), centers, MarkerSearch(diameter_px=8.0))
    assert isinstance(outcome, Lost)
    assert "quadrilateral" in outcome.detail


def test_a_dotted_cloth_is_searched_as_its_dots_are_one_by_one():
    """The first of dots that overlap is kept, however many there are."""
    rng = np.random.default_rng(3)
    centers = rng.uniform(0.0, 200.0, (300, 2))
    blobs = [marker_stage._Blob(center_px=center, score=0.0, diameter_px=rng.uniform(4, 20)) for center in centers]
    kept = []
    for blob in blobs:
        if all(math.dist(blob.center_px, other.center_px) > 0.5 * blob.diameter_px for other in kept):
            kept.append(blob)
    assert 10 < len(kept) < 300
    assert marker_stage._distinct(blobs) == kept
