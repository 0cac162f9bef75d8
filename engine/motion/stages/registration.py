"""Registration of colour pixels to the depth camera (article, section 4.2).

The article registers whole depth pictures to the colour camera: 300,000 pixels for a region that needs a few hundred.
Here only the nodes of the region are registered: the point at the expected depth on a colour pixel's ray is projected
into the depth camera, distortion included. The result changes by about 0.02 px per mm of depth, so the expected depth
may be some millimetres out of date.
"""

from dataclasses import dataclass

import numpy as np

from engine.core.compiled import kernels
from engine.core.frames import FloatArray
from engine.core.geometry import Intrinsics, RigidTransform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Aligned:
    """Points in the depth camera: pixels (x, y) [px] and rays (x/z, y/z), both of shape (N, 2)."""

    pixels_px: FloatArray
    rays: FloatArray


def align(
    color_rays: FloatArray, expected_depth_mm: FloatArray, depth_from_color: RigidTransform, depth_camera: Intrinsics
) -> Aligned:
    """Project the points on colour rays into the depth camera.

    Parameters
    ----------
    color_rays
        Rays of the colour camera (x/z, y/z, 1), shape (N, 3).
    expected_depth_mm
        Expected depth along the depth camera's axis [mm], shape (N,).
    """
    compiled = kernels()
    if compiled is None:
        return _align(color_rays, expected_depth_mm, depth_from_color, depth_camera)
    pixels_px, rays = np.empty((2, len(color_rays), 2))
    compiled.align_nodes(
        np.ascontiguousarray(color_rays),
        np.ascontiguousarray(expected_depth_mm),
        np.ascontiguousarray(depth_from_color.rotation),
        np.ascontiguousarray(depth_from_color.translation_mm),
        depth_camera.constants,
        pixels_px,
        rays,
    )
    return Aligned(pixels_px=pixels_px, rays=rays)


def _align(
    color_rays: FloatArray, expected_depth_mm: FloatArray, depth_from_color: RigidTransform, depth_camera: Intrinsics
) -> Aligned:
    """Project with numpy."""
    directions = color_rays @ depth_from_color.rotation.T
    along = (expected_depth_mm - depth_from_color.translation_mm[2]) / directions[:, 2]
    points = along[:, None] * directions + depth_from_color.translation_mm
    return Aligned(pixels_px=depth_camera.project(points), rays=points[:, :2] / points[:, 2:])
