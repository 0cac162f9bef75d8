"""Two more stickers at the costal margin give the line between thorax and abdomen, or nothing does."""

import cv2
import numpy as np
import pytest

from engine.core.frames import Markers
from engine.motion.stages.markers import MarkerSearch, find_markers, find_stickers
from engine.motion.stages.roi import color_from_roi
from engine.motion.tracking.costal_line import agreed_split, find_split, split_between
from lab.phantom.laser import CostalStickers
from lab.phantom.scene import Script
from lab.phantom.studio import Studio
from lab.phantom.view import Frustum

CORNERS = np.array([[240.3, 120.7], [402.6, 124.2], [392.1, 384.9], [246.8, 380.4]])
ROI_MAP = color_from_roi(CORNERS)


def in_picture(grid_rc):
    """Colour pixels of grid points (row, column)."""
    points = np.asarray(grid_rc, dtype=np.float64)[:, ::-1].reshape(-1, 1, 2)
    return cv2.perspectiveTransform(points, ROI_MAP).reshape(-1, 2)


def test_the_line_runs_through_both_stickers_and_on_to_both_edges():
    right, left = split_between(np.array([[150.0, 10.0], [190.0, 180.0]]))
    assert np.interp([10.0, 180.0], [0.0, 199.0], [right, left]) == pytest.approx([150.0, 190.0])


def test_two_stickers_among_corners_and_other_blobs_are_found_in_any_order():
    others = [(60.0, 100.0), (200.0, 90.0), (170.0, -80.0), (-60.0, 20.0)]
    candidates = np.concatenate([in_picture([(190.0, 195.0), (150.0, 4.0), *others]), CORNERS])
    expected = split_between(np.array([[150.0, 4.0], [190.0, 195.0]]))
    for order in range(5):
        shuffled = np.random.default_rng(order).permutation(candidates)
        assert find_split(shuffled, ROI_MAP) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    "extra_rc",
    [
        [],
        [(150.0, 4.0)],
        [(150.0, 4.0), (190.0, 150.0)],  # one too far inside
        [(20.0, 4.0), (190.0, 195.0)],  # one beside a corner
        [(150.0, 4.0), (170.0, 6.0), (190.0, 195.0)],  # two at one side
    ],
    ids=["none", "one", "inside", "corner", "two"],
)
def test_a_picture_without_one_sticker_at_each_side_reports_nothing(extra_rc):
    candidates = np.concatenate([in_picture(extra_rc), CORNERS]) if extra_rc else CORNERS
    assert find_split(candidates, ROI_MAP) is None


def test_a_picture_without_any_sticker_reports_nothing():
    assert find_split(np.empty((0, 2)), ROI_MAP) is None


def test_the_median_settles_it_and_a_wild_picture_does_not_matter():
    seen = [(150.0 + 0.1 * i, 190.0) for i in range(9)] + [(60.0, 300.0), None]
    assert agreed_split(seen) == pytest.approx((150.35, 190.0), abs=0.2)


def test_too_few_pictures_settle_nothing():
    assert agreed_split([(150.0, 190.0)] * 4) is None
    assert agreed_split([(150.0, 190.0)] * 6 + [None] * 7) is None
    assert agreed_split([]) is None


@pytest.fixture(scope="module")
def photographed():
    """A virtual volunteer's pictures with two more stickers at the ribs, and where those truly are in the picture."""
    script = Script(scenario="regular", volunteer=3, seconds=6.0, fps=30.0, seed=2, has_extra_markers=True)
    studio = Studio(script)
    scene, costal = studio.scene, CostalStickers(studio.scene.anatomy)
    pictures, truth_px = [], []
    for frame in range(6):
        time_s = 0.5 + 0.7 * frame
        camera_from_body = Frustum(scene.rig.color_from_couch, scene.timeline.pose(time_s)).camera_from_body
        centers_mm = camera_from_body.apply(costal.centers_mm(scene.breathing.weights(time_s)))
        pictures.append((studio.color_frame(frame, time_s), scene.markers_px(time_s)))
        truth_px.append(scene.rig.color.project(centers_mm))
    search = MarkerSearch(diameter_px=20.0 * scene.rig.color.fx / float(centers_mm[:, 2].mean()))
    return pictures, truth_px, search


def test_on_a_volunteer_the_line_is_found_to_a_pixel_of_the_grid(photographed):
    pictures, truth_px, search = photographed
    seen, true = [], []
    for (picture, corners_px), extra_px in zip(pictures, truth_px, strict=True):
        roi_map = color_from_roi(corners_px)
        seen.append(find_split(find_stickers(picture, search), roi_map))
        true.append(find_split(extra_px, roi_map))
    assert all(split is not None for split in true)
    assert agreed_split(seen) == pytest.approx(np.median(np.array(true), axis=0), abs=1.0)


def test_two_more_stickers_are_not_taken_for_corners(photographed):
    for picture, corners_px in photographed[0]:
        found = find_markers(picture, photographed[2])
        assert isinstance(found, Markers)
        assert np.abs(found.centers_px - corners_px).max() < 0.5
