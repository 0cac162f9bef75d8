"""Where the sensor reads nothing: shadows of its projector, steep and shiny places, the rim, and the dark room.

A hole is not sharp: near its edge readings come and go from frame to frame. ``odds`` holds, for each pixel, the level a
standard normal draw must pass for a reading: -inf always, +inf never.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.frames import BoolArray, FloatArray
from engine.phantom.body import Map, Material, blur
from engine.phantom.rig import PROJECTOR_BASELINE_MM

HOLE_SHARE = 0.245
FLICKER_SHARE = 0.07
RIM_PX = 6
PATCH_PX = 4.0
_STEEPEST = 2.2
_SHADOW_SLACK_PX = 0.6
# In the flicker zone a pixel reads in 7 to 93 % of the frames.
_ZONE_LEVEL = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Holes:
    """Still holes and their flickering edges; ``level`` has shape (H, W), ``is_edge`` marks where jumps gather."""

    level: Map
    is_edge: BoolArray


def cast_shadow(depth_mm: FloatArray, focal_px: float) -> BoolArray:
    """Where the projector's light is blocked by something nearer, for a projector beside the camera in +x."""
    columns = np.arange(depth_mm.shape[1], dtype=np.float32)
    seen_from_projector = columns - np.float32(focal_px * PROJECTOR_BASELINE_MM) / depth_mm
    nearest = np.minimum.accumulate(seen_from_projector[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(seen_from_projector > nearest + np.float32(_SHADOW_SLACK_PX))


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
        What each pixel sees of the body.
    is_shiny
        Patches of the shirt that mirror the projector.
    is_room
        Floor, where dark things stand.
    darkness
        A fixed smooth random field; where it is highest the floor is too dark to read, until the share of holes is met.
    body_share, is_body
        Share of the body that is not read either, where one is asked for: patches of about a centimetre.
    """
    never = cast_shadow(depth_mm, focal_px) | _is_steep(depth_mm, focal_px) | is_shiny
    never |= material == Material.HAIR
    never[:RIM_PX] = never[-RIM_PX:] = True
    never[:, :RIM_PX] = never[:, -RIM_PX:] = True
    if body_share is not None:
        never |= _patches(is_body, body_share)
    wanted = int(HOLE_SHARE * never.size) - int(np.count_nonzero(never))
    free = is_room & ~never
    if wanted > 0 and free.any():
        share = min(1.0, wanted / int(np.count_nonzero(free)))
        never |= free & (darkness > np.quantile(darkness[free], 1.0 - share))
    never = cv2.medianBlur(never.astype(np.uint8), 3) > 0
    outside = cv2.distanceTransform((~never).astype(np.uint8), cv2.DIST_L2, 3)
    inside = cv2.distanceTransform(never.astype(np.uint8), cv2.DIST_L2, 3)
    # A rough edge: whole-pixel distances come in so few values that no share could be met otherwise.
    rough = np.random.default_rng(9).uniform(-0.4, 0.4, never.shape)
    distance = np.where(never, 0.5 - inside, outside - 0.5) + rough
    reach = float(np.quantile(np.abs(distance), FLICKER_SHARE))
    level = np.where(never, np.inf, -np.inf).astype(np.float32)
    zone = np.abs(distance) <= reach
    level[zone] = -_ZONE_LEVEL * distance[zone] / reach
    return Holes(level=level, is_edge=zone & ~never)


def _patches(is_body: BoolArray, share: float) -> BoolArray:
    """Patches all over the body that cover a share of it."""
    field = blur(np.random.default_rng(10).standard_normal(is_body.shape, dtype=np.float32), PATCH_PX)
    if share <= 0.0:
        return np.zeros_like(is_body)
    return np.asarray(is_body & (field >= np.quantile(field[is_body], 1.0 - share)))


def _is_steep(depth_mm: FloatArray, focal_px: float) -> BoolArray:
    """Where the surface turns so far away that too little light comes back."""
    down, right = np.gradient(depth_mm)
    return np.asarray(np.hypot(down, right) * focal_px / depth_mm > _STEEPEST)
