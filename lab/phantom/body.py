"""The body sampled: heights 1 mm apart, the materials it is made of, and the light on it.

Sampled once for each volunteer and process; every picture is read from these maps. Index (row, column) of a map is
(y + half_y, x + half_x) in mm.
"""

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, FloatArray
from lab.phantom.anatomy import BODY_HALF_MM, BOTTOM_MM, MODES, TOP_MM, TRUNK_HALF_MM, Anatomy, Spot

Map = npt.NDArray[np.float32]
# Lamp over the right shoulder: direction to it (x left, y inferior, h up), and the share of ambient light.
_LAMP = np.array([-0.35, -0.30, 0.89])
_AMBIENT = 0.42
STRIPE_MM = 15.0


class Material(IntEnum):
    """Surface material of a point of the body."""

    NONE = 0
    SHIRT = 1
    SKIN = 2
    HAIR = 3
    TROUSERS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Body:
    """One volunteer's body, sampled on a grid of 1 mm.

    Attributes
    ----------
    height_mm, material
        Height at rest over the couch and material, shape (1001, 661); 0 and NONE beside the body.
    trunk_mm, trunk_modes
        The same heights and the eight fields where the skin moves, shapes (593, 473) and (8, 593, 473).
    slope
        Gradient of ``height_mm`` along x and y, shape (2, 1001, 661).
    lit_rgb
        Colour under the lamp, before the camera, shape (1001, 661, 3).
    """

    anatomy: Anatomy
    height_mm: Map
    material: npt.NDArray[np.uint8]
    trunk_mm: Map
    trunk_modes: Map
    slope: Map
    lit_rgb: npt.NDArray[np.uint8]

    def trunk_height(self, weights_mm: FloatArray) -> Map:
        """Height of the trunk's box for one set of mode weights [mm]."""
        height = self.trunk_mm.copy()
        part = np.empty_like(height)
        for weight, mode in zip(weights_mm, self.trunk_modes, strict=True):
            np.multiply(mode, np.float32(weight), out=part)
            height += part
        return height


def sample_body(anatomy: Anatomy) -> Body:
    """Sample height, material, motion fields and colour of a volunteer."""
    x_mm, y_mm = _grid(BODY_HALF_MM)
    height, material = _assemble(anatomy, x_mm, y_mm)
    trunk = _trunk_window()
    trunk_x, trunk_y = _grid(TRUNK_HALF_MM)
    modes = anatomy.modes(trunk_x, trunk_y) * (material[trunk] != Material.NONE)
    down, right = np.gradient(blur(height, 1.0))
    slope = np.stack([right, down]).astype(np.float32)
    assert modes.shape[0] == MODES
    return Body(
        anatomy=anatomy,
        height_mm=height,
        material=material,
        trunk_mm=np.ascontiguousarray(height[trunk]),
        trunk_modes=np.ascontiguousarray(modes, dtype=np.float32),
        slope=slope,
        lit_rgb=_light(anatomy, material, slope, x_mm, y_mm),
    )


def blur(field: Map, sigma: float) -> Map:
    """Blur a map with a Gaussian of ``sigma`` samples."""
    return np.asarray(cv2.GaussianBlur(field, (0, 0), sigma), dtype=np.float32)


def _grid(half_mm: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    half_x, half_y = (int(half) for half in half_mm)
    return np.meshgrid(np.arange(-half_x, half_x + 1.0), np.arange(-half_y, half_y + 1.0))


def _trunk_window() -> tuple[slice, slice]:
    (body_x, body_y), (trunk_x, trunk_y) = BODY_HALF_MM, TRUNK_HALF_MM
    return (
        slice(int(body_y - trunk_y), int(body_y + trunk_y) + 1),
        slice(int(body_x - trunk_x), int(body_x + trunk_x) + 1),
    )


def _assemble(anatomy: Anatomy, x_mm: FloatArray, y_mm: FloatArray) -> tuple[Map, npt.NDArray[np.uint8]]:
    build = anatomy.build
    trunk = np.where(
        (anatomy.side(x_mm, y_mm) < 1.0) & (y_mm > TOP_MM) & (y_mm < BOTTOM_MM + 80.0),
        anatomy.trunk_height(x_mm, y_mm),
        0.0,
    )
    height = trunk.astype(np.float32)
    material = np.where(trunk > 0.0, np.where(y_mm > BOTTOM_MM - 60.0, Material.TROUSERS, Material.SHIRT), 0)
    half, neck = build.half_width_mm, 0.72 * build.chest_mm
    parts = [
        (_ellipsoid(x_mm, y_mm, (2.0, -375.0, 115.0), (78.0, 112.0, 108.0)), Material.SKIN),
        (_capsule(x_mm, y_mm, (0.0, -235.0), (1.0, -330.0), neck - 62.0, 62.0), Material.SKIN),
    ]
    for side in (-1.0, 1.0):
        shoulder, elbow, wrist = (
            (side * (half * 1.02), -178.0),
            (side * (half * 1.04 + 40.0), 40.0),
            (side * (half * 1.04 + 44.0), 270.0),
        )
        parts.append((_capsule(x_mm, y_mm, shoulder, elbow, 72.0, 46.0), Material.SHIRT))
        parts.append((_capsule(x_mm, y_mm, elbow, wrist, 58.0, 36.0), Material.SKIN))
        leg = _capsule(x_mm, y_mm, (side * 0.5 * half, 280.0), (side * 0.58 * half, 520.0), 70.0, 0.47 * half)
        parts.append((leg, Material.TROUSERS))
    for part, part_material in parts:
        is_over = part > height
        height[is_over] = part[is_over]
        material[is_over] = part_material
    is_hair = (material == Material.SKIN) & (y_mm < -425.0 + 0.004 * x_mm**2)
    material[is_hair] = Material.HAIR
    return height, material.astype(np.uint8)


def _ellipsoid(
    x_mm: FloatArray, y_mm: FloatArray, center_mm: tuple[float, float, float], axes_mm: tuple[float, float, float]
) -> FloatArray:
    inside = 1.0 - ((x_mm - center_mm[0]) / axes_mm[0]) ** 2 - ((y_mm - center_mm[1]) / axes_mm[1]) ** 2
    return np.where(inside > 0.0, center_mm[2] + axes_mm[2] * np.sqrt(np.maximum(inside, 0.0)), 0.0)


def _capsule(
    x_mm: FloatArray,
    y_mm: FloatArray,
    start_mm: tuple[float, float],
    end_mm: tuple[float, float],
    axis_height_mm: float,
    radius_mm: float,
) -> FloatArray:
    """Height of a round limb with a horizontal axis [mm], 0 beside it."""
    along = np.array(end_mm) - np.array(start_mm)
    share = ((x_mm - start_mm[0]) * along[0] + (y_mm - start_mm[1]) * along[1]) / float(along @ along)
    share = np.clip(share, 0.0, 1.0)
    away2 = (x_mm - start_mm[0] - share * along[0]) ** 2 + (y_mm - start_mm[1] - share * along[1]) ** 2
    inside = radius_mm**2 - away2
    return np.where(inside > 0.0, axis_height_mm + np.sqrt(np.maximum(inside, 0.0)), 0.0)


def _light(
    anatomy: Anatomy, material: npt.NDArray[np.uint8], slope: Map, x_mm: FloatArray, y_mm: FloatArray
) -> npt.NDArray[np.uint8]:
    palette = np.zeros((5, 3), np.float32)
    palette[Material.SHIRT] = anatomy.build.shirt_rgb
    palette[Material.SKIN] = anatomy.build.skin_rgb
    palette[Material.HAIR] = (58.0, 46.0, 38.0)
    palette[Material.TROUSERS] = (78.0, 82.0, 96.0)
    albedo = palette[material]
    if anatomy.build.stripe_rgb is not None:
        albedo[(material == Material.SHIRT) & (y_mm % (2.0 * STRIPE_MM) < STRIPE_MM)] = anatomy.build.stripe_rgb
    _draw_spot(albedo, anatomy.button, x_mm, y_mm, (232.0, 230.0, 224.0))
    wrist = Spot(x_mm=anatomy.build.half_width_mm * 1.04 + 42.0, y_mm=205.0, radius_mm=16.0)
    _draw_spot(albedo, wrist, x_mm, y_mm, (236.0, 238.0, 240.0))
    length = np.sqrt(slope[0] ** 2 + slope[1] ** 2 + 1.0)
    facing = np.maximum((-slope[0] * _LAMP[0] - slope[1] * _LAMP[1] + _LAMP[2]) / length, 0.0)
    shade = (_AMBIENT + (1.0 - _AMBIENT) * facing) * _falloff(x_mm, y_mm) * _cloth_grain(anatomy, material)
    return np.asarray(np.clip(albedo * shade[..., None], 0.0, 255.0).astype(np.uint8))


def _falloff(x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Relative brightness, which decreases with the distance from the lamp."""
    return np.asarray(1.0 - 0.00055 * x_mm - 0.00035 * y_mm)


def _cloth_grain(anatomy: Anatomy, material: npt.NDArray[np.uint8]) -> FloatArray:
    rng = np.random.default_rng((7, round(anatomy.build.bmi * 10)))
    grain = blur(rng.standard_normal(material.shape, dtype=np.float32), 1.2)
    blotch = blur(rng.standard_normal(material.shape, dtype=np.float32), 25.0)
    return np.asarray(1.0 + 0.25 * grain + 1.5 * blotch)


def _draw_spot(albedo: Map, spot: Spot, x_mm: FloatArray, y_mm: FloatArray, rgb: tuple[float, float, float]) -> None:
    is_inside: BoolArray = (x_mm - spot.x_mm) ** 2 + (y_mm - spot.y_mm) ** 2 < spot.radius_mm**2
    albedo[is_inside] = rgb
