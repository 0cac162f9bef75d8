"""A plane or a drum before a camera, and what its errors leave of the fit."""

import numpy as np
import pytest

from engine.qa.surface_fit import fit_cylinder, fit_plane, points_mm

FOCAL_PX = 570.0
Y, X = np.mgrid[0:120, 0:160]
RAYS = np.stack([(X - 79.5) / FOCAL_PX, (Y - 59.5) / FOCAL_PX, np.ones_like(X, dtype=float)], axis=-1)


def drum_mm(radius_mm, *, turned=False, slope=0.0, top_mm=850.0):
    """Depth of a cylinder across the view whose axis is inclined by ``slope``; ``turned`` along the columns."""
    across, along = (RAYS[..., 0], RAYS[..., 1]) if turned else (RAYS[..., 1], RAYS[..., 0])
    depth = np.full(X.shape, top_mm)
    for _ in range(60):  # the ray's depth where it meets the cylinder
        axis_mm = top_mm + radius_mm + slope * along * depth
        inside = np.maximum(radius_mm**2 - np.square(across * depth), 0.0)
        depth = axis_mm - np.sqrt(inside) * np.sqrt(1.0 + slope**2)
    return depth


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("radius_mm", [120.0, 150.0, 300.0])
def test_a_drum_has_its_radius_and_leaves_little(radius_mm, turned):
    noise = np.random.default_rng(1).normal(0.0, 0.3, X.shape)
    found = fit_cylinder(points_mm(drum_mm(radius_mm, turned=turned, slope=0.03) + noise, RAYS), radius_mm + 12.0)
    assert found.radius_mm == pytest.approx(radius_mm, abs=1.0)
    assert found.rest_mm < 0.3


def test_a_depth_that_is_compressed_shows_as_another_radius():
    """By 10 %: a plane at one distance could not show it."""
    true_mm = drum_mm(150.0)
    compressed_mm = 850.0 + 0.9 * (true_mm - 850.0)
    found = fit_cylinder(points_mm(compressed_mm, RAYS), 150.0)
    assert found.radius_mm > 157.0
    flat = np.full(X.shape, 850.0)
    assert fit_plane(points_mm(850.0 + 0.9 * (flat - 850.0), RAYS)).rest_mm < 1e-6


def test_a_plane_is_flat_however_it_is_inclined_and_a_bump_is_not():
    plane_mm = 850.0 / (1.0 + 0.1 * RAYS[..., 0] - 0.05 * RAYS[..., 1])
    assert fit_plane(points_mm(plane_mm, RAYS)).rest_mm < 1e-6
    bump_mm = plane_mm - 9.0 * np.exp(-np.square(np.hypot(X - 80, Y - 60) / 20.0))
    assert fit_plane(points_mm(bump_mm, RAYS)).rest_mm > 1.0


def test_too_few_points_are_no_surface():
    depth_mm = np.full(X.shape, np.nan)
    depth_mm[:40, :40] = 850.0
    points = points_mm(depth_mm, RAYS)
    assert len(points) == 25
    assert fit_plane(points) is None
    assert fit_cylinder(points, 150.0) is None
