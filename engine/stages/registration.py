"""Which depth pixel sees what a colour pixel sees (article, section 4.2).

The article aligns whole depth pictures with the colour camera: 300,000 pixels for a region that needs a few hundred.
Here only the nodes of the region are aligned: a colour pixel's ray is cut at the depth expected there, and that point
is projected into the depth camera, distortion included. Alignment moves by about 0.02 px a millimetre of depth, so the
expected depth may be some millimetres old.
"""

from dataclasses import dataclass

from engine.frames import FloatArray
from engine.geometry import Intrinsics, RigidTransform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Aligned:
    """Where the depth camera sees points: pixels (x, y) [px] and rays (x/z, y/z), both of shape (N, 2)."""

    pixels_px: FloatArray
    rays: FloatArray


def align(
    color_rays: FloatArray, expected_depth_mm: FloatArray, depth_from_color: RigidTransform, depth_camera: Intrinsics
) -> Aligned:
    """Find where the depth camera sees the points that colour rays hit.

    Parameters
    ----------
    color_rays
        Rays of the colour camera (x/z, y/z, 1), shape (N, 3).
    expected_depth_mm
        Depth expected there, along the depth camera's axis [mm], shape (N,).
    """
    directions = color_rays @ depth_from_color.rotation.T
    along = (expected_depth_mm - depth_from_color.translation_mm[2]) / directions[:, 2]
    points = along[:, None] * directions + depth_from_color.translation_mm
    return Aligned(pixels_px=depth_camera.project(points), rays=points[:, :2] / points[:, 2:])
