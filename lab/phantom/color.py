"""The colour picture: body, room and stickers under uneven light, through a lens, with noise.

A sticker is drawn analytically: a pixel's coverage follows from its distance to the rim of the tilted disc, blurred by
pixel and lens. Its centre is that of the disc to 0.01 px at every sub-pixel position.
"""

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from engine.core.frames import ColorImage, FloatArray
from engine.core.geometry import Intrinsics, RigidTransform
from lab.phantom.anatomy import BODY_HALF_MM, STICKER_RADIUS_MM
from lab.phantom.body import Map, blur
from lab.phantom.builds import NO_DEPARTURE, Departure
from lab.phantom.rig import HEIGHT_PX, WIDTH_PX
from lab.phantom.truth import Grid
from lab.phantom.view import Hit, Rays, View

BLUR_PX = 0.75
STICKER_RGB = (238.0, 237.0, 232.0)
NOISE_AT_WHITE = 3.2
MOST_AMPLIFIED, READ_NOISE = 16.0, 0.25
"""Largest gain of the camera, and noise of its electronics at a gain of 1 [grey levels]."""
SHADOW_S, PENUMBRA_PX = 40.0, np.float32(60.0)
"""Time in which the gantry's shadow comes and goes, and width of its edge."""
RING_RADIUS_MM, RING_RGB = 32.0, (14.0, 14.0, 15.0)
_SHEET_RGB, _FLOOR_RGB, _RAIL_RGB = (186.0, 191.0, 198.0), (98.0, 96.0, 92.0), (60.0, 62.0, 66.0)
_MARGIN_PX = 96
_PATCH_PX = 14


class ColorCamera:
    """Exposure of the colour camera: uneven light and noise."""

    def __init__(self, camera: Intrinsics, seed: int, departure: Departure = NO_DEPARTURE) -> None:
        self._camera = camera
        self._light = 1.0 if departure.light is None else float(departure.light)
        self._shadow = np.float32(departure.shadow or 0.0)
        self._seed = seed
        columns, rows = np.meshgrid(np.arange(WIDTH_PX, dtype=np.float32), np.arange(HEIGHT_PX, dtype=np.float32))
        x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
        vignette = 1.0 / (1.0 + 0.55 * (x * x + y * y)) ** 2
        gradient = 1.0 + 0.10 * (x - 0.4 * y)
        self._gain = np.repeat((vignette * gradient)[..., None], 3, axis=2).astype(np.float32)
        rng = np.random.default_rng((seed, 5))
        size = (HEIGHT_PX + _MARGIN_PX, WIDTH_PX + _MARGIN_PX, 3)
        self._noise = rng.standard_normal(size, dtype=np.float32) * np.float32(NOISE_AT_WHITE / np.sqrt(255.0))

    def expose(self, scene: npt.NDArray[np.uint8], frame: int, time_s: float = 0.0) -> ColorImage:
        """Apply uneven light and shot noise, which grows with the root of brightness, to a blurred scene.

        In a darker room the camera amplifies what it receives, and its noise with that.
        """
        rng = np.random.default_rng((self._seed, 6, frame))
        top, left = (int(value) for value in rng.integers(0, _MARGIN_PX + 1, 2))
        light = cv2.multiply(scene, self._gain, dtype=cv2.CV_32F)
        if self._shadow:
            light = np.asarray(light * self._shade(time_s))
        amplified = min(1.0 / self._light, MOST_AMPLIFIED)
        if amplified > 1.0:
            light = np.asarray(light * np.float32(self._light * amplified))
        field = self._noise[top : top + HEIGHT_PX, left : left + WIDTH_PX]
        scale = float(rng.choice(np.array([-1.0, 1.0])) * np.sqrt(amplified))
        noise = cv2.multiply(cv2.sqrt(light), field, scale=scale)
        if amplified > 1.0:
            dark = rng.standard_normal(light.shape, dtype=np.float32)
            noise = np.asarray(noise + dark * np.float32(READ_NOISE * amplified))
        return np.asarray(cv2.add(light, noise, dtype=cv2.CV_8U), dtype=np.uint8)

    def _shade(self, time_s: float) -> Map:
        """Share of the light that is left, shape (1, 640, 1): the gantry's shadow comes from the picture's left."""
        share = abs(2.0 * ((time_s / SHADOW_S) % 1.0) - 1.0)
        columns = np.arange(WIDTH_PX, dtype=np.float32)
        inside = np.clip((np.float32(WIDTH_PX * (1.0 - share)) - columns) / PENUMBRA_PX, 0.0, 1.0)
        return np.asarray((1.0 - self._shadow * inside)[None, :, None], dtype=np.float32)


def paint_room(view: View, seed: int) -> npt.NDArray[np.uint8]:
    """Paint couch, floor, a lamp's reflection on the couch, and the resting body, without blur."""
    rng = np.random.default_rng((seed, 7))
    grain = blur(rng.standard_normal((HEIGHT_PX, WIDTH_PX), dtype=np.float32), 6.0)
    folds = 1.0 + 0.5 * grain[..., None]
    couch = np.where(view.is_couch[..., None], np.array(_SHEET_RGB, np.float32), np.array(_FLOOR_RGB, np.float32))
    rail = view.is_couch & (np.abs(view.room_x_mm) > 284.0)
    couch[rail] = _RAIL_RGB
    room = couch * folds
    for x_mm, y_mm, radius_mm in ((-278.0, -60.0, 19.0), (286.0, 236.0, 7.0)):
        away = np.hypot(view.room_x_mm - x_mm, view.room_y_mm - y_mm)
        glare = view.is_couch * np.exp(-0.5 * np.maximum(away - radius_mm, 0.0) ** 2 / 3.0**2)
        room += (252.0 - room) * glare[..., None]
    picture: npt.NDArray[np.uint8] = np.clip(room, 0.0, 255.0).astype(np.uint8)
    return picture


def paint_body(lit_rgb: npt.NDArray[np.uint8], x_mm: Map, y_mm: Map) -> npt.NDArray[np.uint8]:
    """Sample the body's lit colour at body coordinates, shape (..., 3)."""
    half_x, half_y = (np.float32(half) for half in BODY_HALF_MM)
    return np.asarray(cv2.remap(lit_rgb, x_mm + half_x, y_mm + half_y, cv2.INTER_LINEAR), dtype=np.uint8)


def blur_lens(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Apply the lens blur to a picture."""
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR_PX), dtype=np.uint8)


def paint_trunk(
    picture: npt.NDArray[np.uint8], blurred: npt.NDArray[np.uint8], lit_rgb: npt.NDArray[np.uint8], view: View, hit: Hit
) -> npt.NDArray[np.uint8]:
    """Paint the current trunk over the resting picture, given sharp and blurred; return the blurred picture."""
    scene = blurred.copy()
    sharp = picture[view.window].copy()
    np.copyto(sharp, paint_body(lit_rgb, hit.x_mm, hit.y_mm), where=view.is_trunk[..., None])
    scene[view.window] = blur_lens(sharp)
    return scene


def stick(
    scene: npt.NDArray[np.uint8],
    camera: Intrinsics,
    rays: Rays,
    camera_from_body: RigidTransform,
    centers_mm: Grid,
    slopes: Grid,
    light: FloatArray,
    *,
    is_ringed: bool = False,
) -> None:
    """Draw stickers into a blurred scene, ``is_ringed`` on black discs.

    Parameters
    ----------
    centers_mm
        Centres in the body frame (x, y, z down), shape (n, 3).
    slopes
        Gradient of the skin's height there, shape (n, 2).
    light
        Brightness of each, shape (n,).
    """
    disc = (STICKER_RADIUS_MM, STICKER_RGB)
    discs = ((RING_RADIUS_MM, RING_RGB), disc) if is_ringed else (disc,)
    reach = 3 * _PATCH_PX if is_ringed else _PATCH_PX
    centers_px = camera.project(camera_from_body.apply(centers_mm))
    for center_px, center_mm, slope, level in zip(centers_px, centers_mm, slopes, light, strict=True):
        left, top = (int(value) for value in np.rint(center_px).astype(int) - reach)
        if not (0 <= left < camera.width - 2 * reach and 0 <= top < camera.height - 2 * reach):
            continue
        window = slice(top, top + 2 * reach + 1), slice(left, left + 2 * reach + 1)
        directions = np.stack([rays.x[window], rays.y[window], np.ones((2 * reach + 1, 2 * reach + 1))], axis=-1)
        for radius_mm, rgb in discs:
            coverage = _coverage(directions, camera_from_body, center_mm, slope, radius_mm)[..., None]
            patch = scene[window]
            mixed = patch * (1.0 - coverage) + np.array(rgb) * level * coverage
            scene[window] = np.rint(np.clip(mixed, 0.0, 255.0)).astype(np.uint8)


def _coverage(
    directions: Grid, camera_from_body: RigidTransform, center_mm: Grid, slope: Grid, radius_mm: float
) -> Grid:
    """Share of each pixel that a tilted disc covers, shape (h, w), from the pixels' rays, shape (h, w, 3)."""
    center = camera_from_body.apply(center_mm[None])[0]
    # The skin's normal in the body frame (z down) is (slope_x, slope_y, 1), up to its sign and length.
    normal = camera_from_body.rotation @ np.array([slope[0], slope[1], 1.0])
    reach = float(center @ normal) / (directions * normal).sum(axis=-1)
    away_mm = np.sqrt(((directions * reach[..., None] - center) ** 2).sum(axis=-1))
    down, right = np.gradient(away_mm)
    mm_per_px = np.maximum(np.hypot(down, right), 0.2)
    # The gradient of a distance is undefined at the centre; pixels near it are fully covered.
    inside_px = np.where(away_mm < 0.5 * radius_mm, 10.0, (radius_mm - away_mm) / mm_per_px)
    return np.asarray(ndtr(inside_px / np.hypot(BLUR_PX, np.sqrt(1.0 / 12.0))))
