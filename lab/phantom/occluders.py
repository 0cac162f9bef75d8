"""Occluders between camera and body: a hand with its forearm, and a cloth over a sticker.

Both are flat shapes at a height over the couch, with a rounded rim, drawn through the same cameras as the body.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.geometry import Intrinsics, RigidTransform
from lab.phantom.body import Map

_SUBPIXEL = 4
# Capsules of a right hand that reaches in from the patient's left: (x, y) of both ends and radius [mm], relative to the
# middle of the palm.
_HAND = (
    ((0.0, 0.0), (14.0, 0.0), 42.0),
    ((-30.0, -28.0), (-108.0, -40.0), 10.0),
    ((-36.0, -10.0), (-124.0, -14.0), 10.5),
    ((-36.0, 10.0), (-120.0, 14.0), 10.0),
    ((-28.0, 28.0), (-98.0, 40.0), 9.0),
    ((10.0, -34.0), (-40.0, -82.0), 11.0),
    ((30.0, 0.0), (110.0, 10.0), 33.0),
    ((110.0, 10.0), (620.0, 70.0), 44.0),
)
_CLOTH = (((-16.0, -6.0), (18.0, 9.0), 26.0), ((2.0, 14.0), (10.0, -18.0), 22.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Occluder:
    """A shape at (x, y, height) in the couch frame [mm]; ``rim_mm`` is how far its middle stands over its rim."""

    x_mm: float
    y_mm: float
    height_mm: float
    rim_mm: float
    capsules: tuple[tuple[tuple[float, float], tuple[float, float], float], ...]
    rgb: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawn:
    """An occluder in one picture: coverage from 0 to 1, and its depth [mm], shape (H, W)."""

    coverage: Map
    depth_mm: Map


def hand(share: float, chest_mm: float) -> Occluder:
    """Return the hand at ``share`` (0 to 1) of its movement over the chest and back."""
    share_over = 0.5 - 0.5 * float(np.cos(2.0 * np.pi * share))
    return Occluder(
        x_mm=470.0 - 500.0 * share_over,
        y_mm=-20.0 + 60.0 * share,
        height_mm=chest_mm + 210.0,
        rim_mm=24.0,
        capsules=_HAND,
        rgb=(206.0, 160.0, 134.0),
    )


def arm(x_mm: float, y_mm: float, height_mm: float, radius_mm: float) -> Occluder:
    """Return an arm, or a person's side, from the patient's left; its end is at (x, y) of the couch frame."""
    limb = (((0.0, 0.0), (700.0, 20.0), radius_mm),)
    return Occluder(
        x_mm=x_mm, y_mm=y_mm, height_mm=height_mm, rim_mm=0.6 * radius_mm, capsules=limb, rgb=(206.0, 160.0, 134.0)
    )


def cloth(x_mm: float, y_mm: float, skin_mm: float) -> Occluder:
    """Return a cloth on the skin at (x, y) of the couch frame."""
    return Occluder(x_mm=x_mm, y_mm=y_mm, height_mm=skin_mm + 6.0, rim_mm=4.0, capsules=_CLOTH, rgb=(40.0, 74.0, 120.0))


def draw(occluder: Occluder, camera: Intrinsics, camera_from_couch: RigidTransform) -> Drawn:
    """Draw an occluder into a picture of ``camera``."""
    mask: npt.NDArray[np.uint8] = np.zeros((camera.height, camera.width), np.uint8)
    offset = np.array([occluder.x_mm, occluder.y_mm])
    scale = 1 << _SUBPIXEL
    plane_mm = 0.0
    for start, end, radius in occluder.capsules:
        ends = np.array([start, end]) + offset
        points = camera_from_couch.apply(np.column_stack([ends, np.full(2, -occluder.height_mm)]))
        plane_mm = plane_mm or float(points[:, 2].mean())
        pixels = np.rint(camera.project(points) * scale).astype(int)
        thickness = max(1, round(2.0 * radius * camera.fx / float(points[:, 2].mean())))
        first, last = ((int(x), int(y)) for x, y in pixels)
        cv2.line(mask, first, last, 255, thickness, cv2.LINE_AA, _SUBPIXEL)
    coverage = cv2.GaussianBlur(mask, (0, 0), 0.7).astype(np.float32) / np.float32(255.0)
    inside = cv2.distanceTransform((mask > 127).astype(np.uint8), cv2.DIST_L2, 3)
    dome = np.minimum(inside / (0.03 * camera.fx), 1.0)
    return Drawn(coverage=coverage, depth_mm=np.float32(plane_mm) - np.float32(occluder.rim_mm) * dome * (2.0 - dome))


def cover_depth(depth_mm: Map, drawn: Drawn) -> Map:
    """Replace the depth behind an occluder by the occluder's [mm]."""
    return np.where(drawn.coverage > 0.5, drawn.depth_mm, depth_mm)


def cover_color(rgb: npt.NDArray[np.uint8], drawn: Drawn, occluder: Occluder) -> npt.NDArray[np.uint8]:
    """Paint an occluder over a colour picture, darker towards its rim."""
    depth = drawn.depth_mm
    share = (depth.max() - depth) / np.float32(occluder.rim_mm)
    paint = (0.72 + 0.28 * share)[..., None] * np.array(occluder.rgb, np.float32)
    coverage = drawn.coverage[..., None]
    mixed = rgb * (1.0 - coverage) + paint * coverage
    return np.asarray(np.clip(mixed, 0.0, 255.0), dtype=np.uint8)
