"""Cameras and rigid motions are their own inverses, and agree with OpenCV."""

import cv2
import numpy as np

from engine.core.geometry import Intrinsics, RigidTransform

CAMERA = Intrinsics(
    width=640, height=480, fx=572.0, fy=573.0, cx=318.0, cy=241.0, distortion=(-0.08, 0.11, 0.001, -0.0007, 0.02)
)
RNG = np.random.default_rng(0)
POINTS = np.column_stack([RNG.uniform(-300, 300, 200), RNG.uniform(-250, 250, 200), RNG.uniform(600, 1200, 200)])


def test_projection_agrees_with_opencv():
    expected, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(CAMERA.distortion))
    assert np.abs(CAMERA.project(POINTS) - expected.reshape(-1, 2)).max() < 1e-9


def test_a_ray_through_a_projected_point_hits_the_point():
    rays = CAMERA.rays(CAMERA.project(POINTS))
    assert np.abs(rays * POINTS[:, 2:] - POINTS).max() < 1e-3


def test_without_distortion_rays_are_exact():
    plain = Intrinsics(width=640, height=480, fx=570.0, fy=570.0, cx=320.0, cy=240.0)
    rays = plain.rays(plain.project(POINTS))
    assert np.abs(rays * POINTS[:, 2:] - POINTS).max() < 1e-9


def test_a_transform_and_its_inverse_cancel():
    rotation, _ = cv2.Rodrigues(np.array([0.02, -0.3, 0.1]))
    transform = RigidTransform(rotation=rotation, translation_mm=np.array([25.0, -1.0, 3.0]))
    assert np.abs(transform.inverse.apply(transform.apply(POINTS)) - POINTS).max() < 1e-9
