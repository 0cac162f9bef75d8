"""What the SDK says of a camera's lens, as OpenCV's parameters: both put a point on the same pixel."""

import numpy as np
import pyrealsense2 as rs
import pytest

from engine.capture.realsense.camera import _intrinsics

D455_COLOR = [-0.0559, 0.0655, -0.00079, 0.00043, -0.0211]


def made(model, coefficients):
    given = rs.intrinsics()
    given.width, given.height, given.fx, given.fy, given.ppx, given.ppy = 640, 480, 384.2, 383.9, 322.1, 241.7
    given.model, given.coeffs = model, coefficients
    return given


@pytest.mark.parametrize("coefficients", [D455_COLOR, [0.0] * 5])
@pytest.mark.parametrize("model", ["inverse_brown_conrady", "modified_brown_conrady", "brown_conrady"])
def test_a_point_is_seen_where_the_sdk_sees_it(model, coefficients):
    given = made(getattr(rs.distortion, model), coefficients)
    ours = _intrinsics(given)
    pixels = np.random.default_rng(1).uniform((5.0, 5.0), (634.0, 474.0), (200, 2))
    if model == "inverse_brown_conrady":  # its formula leads from a pixel to a ray
        points = np.array([rs.rs2_deproject_pixel_to_point(given, one, 850.0) for one in pixels.tolist()])
    else:
        rays = (pixels - (given.ppx, given.ppy)) / (given.fx, given.fy)
        points = np.column_stack([850.0 * rays, np.full(len(rays), 850.0)])
        pixels = np.array([rs.rs2_project_point_to_pixel(given, one) for one in points.tolist()])
    assert np.abs(ours.project(points) - pixels).max() < 0.12
