"""The region follows the markers through both cameras, and a hole stays a hole."""

import cv2
import numpy as np
import pytest

from engine.calibration.camera_calibration import Calibration
from engine.calibration.quantisation import depth_table_mm
from engine.core.frames import NODE_COLUMNS, NODE_STEP, ROI_COLUMNS, ROI_ROWS, RoiDepth
from engine.core.geometry import Intrinsics, RigidTransform
from engine.motion.stages.preprocessing import fill_holes, smooth_bilateral
from engine.motion.stages.roi import align, at_nodes, color_from_roi, cut_out, roi_nodes

ANGLE = np.radians(1.5)
CALIBRATION = Calibration(
    camera="test",
    depth=Intrinsics(
        width=640, height=480, fx=572.0, fy=573.0, cx=318.0, cy=241.0, distortion=(-0.08, 0.11, 0.001, -0.0007, 0.0)
    ),
    color=Intrinsics(
        width=640, height=480, fx=530.0, fy=531.0, cx=322.0, cy=238.0, distortion=(0.05, -0.12, -0.0008, 0.001, 0.0)
    ),
    color_from_depth=RigidTransform(
        rotation=np.array([[np.cos(ANGLE), -np.sin(ANGLE), 0.0], [np.sin(ANGLE), np.cos(ANGLE), 0.0], [0.0, 0.0, 1.0]]),
        translation_mm=np.array([25.0, 0.6, -1.2]),
    ),
)
AS_READ = depth_table_mm(None)
ROUNDING_MM = 1e-3
"""Where only the order of sums is another; the sensor's own step is 1 mm."""
CORNERS = np.array([[240.0, 120.0], [402.0, 124.0], [392.0, 384.0], [246.0, 380.0]])


def test_a_colour_ray_cut_at_its_depth_lands_on_the_pixel_that_depth_camera_sees():
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-150, 150, 400), rng.uniform(-180, 180, 400), rng.uniform(700, 1000, 400)])
    color_px = CALIBRATION.color.project(CALIBRATION.color_from_depth.apply(points))
    rays = CALIBRATION.color.rays(color_px)
    found = align(rays, points[:, 2], CALIBRATION.color_from_depth.inverse, CALIBRATION.depth)
    assert np.abs(found.pixels_px - CALIBRATION.depth.project(points)).max() < 0.001
    assert np.abs(found.rays - points[:, :2] / points[:, 2:]).max() < 1e-6


def test_the_projective_map_takes_the_corners_of_the_grid_to_the_markers():
    corners = np.array([[0.0, 0.0], [199.0, 0.0], [199.0, 349.0], [0.0, 349.0]])
    found = cv2.perspectiveTransform(corners[None], color_from_roi(CORNERS))[0]
    assert np.abs(found - CORNERS).max() < 1e-9


def test_markers_in_a_line_bound_no_region_and_break_nothing():
    in_line = np.array([[240.0, 120.0], [300.0, 120.0], [360.0, 120.0], [420.0, 120.0]])
    assert np.isfinite(roi_nodes(in_line)).all()
    cut_out(np.full((480, 640), 850, np.uint16), roi_nodes(in_line), AS_READ)


def test_the_corners_of_the_grid_are_the_markers():
    nodes = roi_nodes(CORNERS).reshape(-1, NODE_COLUMNS, 2)
    assert np.allclose(nodes[0, 0], CORNERS[0])
    short = 1.0 - 1.0 / NODE_STEP  # (349, 199) lies one point short of the node at (350, 200)
    fine = nodes[-2, -2] + short * (nodes[-1, -1] - nodes[-2, -2])
    assert np.abs(fine - CORNERS[2]).max() < 0.05


def test_a_tilted_plane_is_cut_out_exactly():
    y, x = np.mgrid[0:480, 0:640].astype(np.float64)
    plane = 800.0 + 0.25 * x + 0.125 * y
    roi = cut_out(np.rint(plane).astype(np.uint16), roi_nodes(CORNERS), AS_READ)
    nodes = roi_nodes(CORNERS)
    expected = 800.0 + 0.25 * nodes[:, 0] + 0.125 * nodes[:, 1]
    error = (at_nodes(roi.depth_mm) - expected).reshape(-1, NODE_COLUMNS)[:-1, :-1]
    assert roi.valid.all()
    assert np.abs(error).max() < 0.6
    assert abs(error.mean()) < 0.05


@pytest.mark.parametrize("stride_px", [2, 4])
def test_a_thinned_region_is_the_full_one_at_every_second_and_fourth_point(stride_px):
    y, x = np.mgrid[0:480, 0:640].astype(np.float64)
    depth = np.rint(800.0 + 0.25 * x + 10.0 * np.sin(0.05 * y)).astype(np.uint16)
    depth[200:210, 300:320] = 0
    full, thin = (cut_out(depth, roi_nodes(CORNERS), AS_READ, stride) for stride in (1, stride_px))
    kept = full.thinned(stride_px)
    # Not to the last bit: pictures of two sizes are divided otherwise among the lanes of a processor's vectors.
    assert np.mean(thin.valid != kept.valid) < 0.001, "a point on the edge of the hole may round to the other side"
    assert np.abs(thin.depth_mm - kept.depth_mm)[thin.valid & kept.valid].max() < ROUNDING_MM


def test_nothing_is_interpolated_across_a_hole():
    depth = np.full((480, 640), 850, np.uint16)
    depth[240:260, 300:330] = 0
    roi = cut_out(depth, roi_nodes(CORNERS), AS_READ)
    assert not roi.valid.all()
    assert np.abs(roi.depth_mm[roi.valid] - 850.0).max() < 0.01
    assert np.all(roi.depth_mm[~roi.valid] == 0.0)


def test_with_every_second_reading_gone_what_is_left_is_still_true():
    y, x = np.mgrid[0:480, 0:640].astype(np.float64)
    plane = 800.0 + 0.25 * x + 0.125 * y
    depth = np.where(np.random.default_rng(2).random(plane.shape) < 0.5, np.rint(plane), 0.0).astype(np.uint16)
    roi = cut_out(depth, roi_nodes(CORNERS), AS_READ)
    whole = cut_out(np.rint(plane).astype(np.uint16), roi_nodes(CORNERS), AS_READ)
    error = (roi.depth_mm - whole.depth_mm)[roi.valid]
    assert 0.4 < roi.valid.mean() < 0.6
    assert np.abs(error).max() < 0.5
    assert abs(error.mean()) < 0.01


@pytest.mark.parametrize("shift", [(-500.0, 0.0), (900.0, 0.0), (0.0, 800.0)])
def test_a_region_outside_of_the_picture_is_all_hole(shift):
    roi = cut_out(np.full((480, 640), 850, np.uint16), roi_nodes(CORNERS + np.array(shift)), AS_READ)
    assert not roi.valid.any()


def _roi(hole):
    depth = np.full((ROI_ROWS, ROI_COLUMNS), 850.0, np.float32)
    depth[:, 100:] = 900.0
    valid = np.ones_like(depth, dtype=bool)
    valid[hole] = False
    return RoiDepth(depth_mm=np.where(valid, depth, np.float32(0.0)), valid=valid)


def test_a_small_hole_takes_the_mode_of_its_neighbours_and_not_their_mean():
    filled = fill_holes(_roi((slice(100, 102), slice(98, 100))))
    assert filled.valid.all()
    assert np.all(filled.depth_mm[100:102, 98:100] == 850.0)


def test_a_large_hole_stays_a_hole():
    filled = fill_holes(_roi((slice(100, 160), slice(20, 80))))
    assert not filled.valid[130, 50]
    assert not filled.valid.all()


def test_the_bilateral_filter_smooths_noise_keeps_edges_and_ignores_holes():
    rng = np.random.default_rng(5)
    clean = _roi((slice(50, 90), slice(30, 70)))
    noisy = RoiDepth(
        depth_mm=np.where(clean.valid, clean.depth_mm + rng.normal(0, 1.0, clean.valid.shape), 0.0).astype(np.float32),
        valid=clean.valid.copy(),
    )
    smooth = smooth_bilateral(noisy)
    error = (smooth.depth_mm - clean.depth_mm)[clean.valid]
    assert error.std() < 0.5
    assert abs(error.mean()) < 0.02
    beside_hole = smooth.depth_mm[49, 30:70]
    assert np.abs(beside_hole - 850.0).max() < 2.0
    beside_edge = smooth.depth_mm[200:300, 99]
    assert np.abs(beside_edge - 850.0).max() < 3.0
