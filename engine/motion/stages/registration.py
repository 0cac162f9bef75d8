"""Registration of colour pixels to the depth camera (article, section 4.2).

The article registers whole depth pictures to the colour camera: 300,000 pixels for a region that needs a few hundred.
Here only the nodes of the region are registered: the point at the expected depth on a colour pixel's ray is projected
into the depth camera, distortion included. The result changes by about 0.02 px per mm of depth, so the expected depth
may be some millimetres out of date.
"""

from dataclasses import dataclass

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
    directions = color_rays @ depth_from_color.rotation.T
    along = (expected_depth_mm - depth_from_color.translation_mm[2]) / directions[:, 2]
    points = along[:, None] * directions + depth_from_color.translation_mm
    return Aligned(pixels_px=depth_camera.project(points), rays=points[:, :2] / points[:, 2:])
