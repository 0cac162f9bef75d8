"""Pixels without a reading: shadows of the projector, steep and shiny surfaces, the picture's rim, and dark objects.

Holes are not sharp: near their edges readings flicker from frame to frame. `Holes.level` is, for each pixel, the level
that a standard normal draw must exceed for a reading: -inf always reads, +inf never.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, FloatArray
from engine.lab.phantom.body import Map, Material, blur
from engine.lab.phantom.rig import PROJECTOR_BASELINE_MM

HOLE_SHARE = 0.245
FLICKER_SHARE = 0.07
RIM_PX = 6
PATCH_PX = 4.0
_STEEPEST = 2.2
_SHADOW_SLACK_PX = 0.6
# In the flicker zone a pixel has a reading in 7 to 93 % of the frames.
_ZONE_LEVEL = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Holes:
    """Holes of one pose: the level of a reading, and the edges, where jumps are frequent, both of shape (H, W)."""

    level: Map
    is_edge: BoolArray


def cast_shadow(depth_mm: FloatArray, focal_px: float) -> BoolArray:
    """Pixels in the projector's shadow, for a projector beside the camera in +x, shape (H, W)."""
    columns = np.arange(depth_mm.shape[1], dtype=np.float32)
    projector_columns = columns - np.float32(focal_px * PROJECTOR_BASELINE_MM) / depth_mm
    nearest = np.minimum.accumulate(projector_columns[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(projector_columns > nearest + np.float32(_SHADOW_SLACK_PX))


def find_holes(
    depth_mm: FloatArray,
    focal_px: float,
    *,
    material: npt.NDArray[np.uint8],
    is_shiny: BoolArray,
    is_room: BoolArray,
    darkness: FloatArray,
    body_share: float | None,
    is_body: BoolArray,
) -> Holes:
    """Lay out the holes of one pose.

    Parameters
    ----------
    depth_mm
        True depth at rest, shape (H, W).
    material
        Material of the body at each pixel, shape (H, W).
    is_shiny
        Patches of the shirt that reflect the projector, shape (H, W).
    is_room
        Pixels of the floor, where dark objects stand, shape (H, W).
    darkness
        A fixed smooth random field; the floor has no reading where it is highest, up to the share `HOLE_SHARE`.
    body_share, is_body
        Additional share of the body without a reading, in patches of about 1 cm; None for none.
    """
    never = cast_shadow(depth_mm, focal_px) | _is_steep(depth_mm, focal_px) | is_shiny
    never |= material == Material.HAIR
    never[:RIM_PX] = never[-RIM_PX:] = True
    never[:, :RIM_PX] = never[:, -RIM_PX:] = True
    if body_share is not None:
        never |= _patches(is_body, body_share)
    missing = int(HOLE_SHARE * never.size) - int(np.count_nonzero(never))
    free = is_room & ~never
    if missing > 0 and free.any():
        share = min(1.0, missing / int(np.count_nonzero(free)))
        never |= free & (darkness > np.quantile(darkness[free], 1.0 - share))
    never = cv2.medianBlur(never.astype(np.uint8), 3) > 0
    outside = cv2.distanceTransform((~never).astype(np.uint8), cv2.DIST_L2, 3)
    inside = cv2.distanceTransform(never.astype(np.uint8), cv2.DIST_L2, 3)
    # A rough edge: whole-pixel distances have too few values for an exact share.
    rough = np.random.default_rng(9).uniform(-0.4, 0.4, never.shape)
    distance = np.where(never, 0.5 - inside, outside - 0.5) + rough
    reach = float(np.quantile(np.abs(distance), FLICKER_SHARE))
    level = np.where(never, np.inf, -np.inf).astype(np.float32)
    zone = np.abs(distance) <= reach
    level[zone] = -_ZONE_LEVEL * distance[zone] / reach
    return Holes(level=level, is_edge=zone & ~never)


def _patches(is_body: BoolArray, share: float) -> BoolArray:
    """Random patches that cover a share of the body, shape (H, W)."""
    field = blur(np.random.default_rng(10).standard_normal(is_body.shape, dtype=np.float32), PATCH_PX)
    if share <= 0.0:
        return np.zeros_like(is_body)
    return np.asarray(is_body & (field >= np.quantile(field[is_body], 1.0 - share)))


def _is_steep(depth_mm: FloatArray, focal_px: float) -> BoolArray:
    """Pixels whose surface is so oblique that too little light returns."""
    down, right = np.gradient(depth_mm)
    return np.asarray(np.hypot(down, right) * focal_px / depth_mm > _STEEPEST)
