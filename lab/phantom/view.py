"""Intersection of one camera's rays with the body in one pose.

Static parts are solved once per pose. The trunk is solved for every frame: Newton steps along each ray with the slope
at rest, on heights sampled every 1 mm and interpolated linearly.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, FloatArray
from engine.core.geometry import Intrinsics, RigidTransform
from lab.phantom.anatomy import BODY_HALF_MM, TRUNK_HALF_MM
from lab.phantom.body import Body, Map
from lab.phantom.rig import chain, couch_from_body, rotate
from lab.phantom.scenarios import Pose

COUCH_HALF_WIDTH_MM = 300.0
FLOOR_MM = -790.0
_LINE = 256
_REST_STEPS = 10
_FRAME_STEPS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rays:
    """Unit-depth rays of all pixels in the camera's frame, x and y of shape (H, W)."""

    x: FloatArray
    y: FloatArray
    singles: tuple[Map, Map]

    @classmethod
    def of(cls, camera: Intrinsics) -> "Rays":
        """Compute the rays of all pixels, lens distortion included."""
        columns, rows = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(float(camera.height)))
        rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]))
        x, y = (rays[:, axis].reshape(columns.shape) for axis in (0, 1))
        # OpenCV reads between pixels exactly in single precision only; in double it rounds places to 1/32 pixel.
        return cls(x=x, y=y, singles=(x.astype(np.float32), y.astype(np.float32)))

    def at(self, pixels_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return rays between pixels (x, y), shape (N, 2); linear, which lens distortion is to 1e-7 within a pixel."""
        # In rows of _LINE: OpenCV limits a picture's side to 32,767 pixels.
        shape = (-(-len(pixels_px) // _LINE), _LINE)
        columns, rows = (np.resize(part.astype(np.float32), shape) for part in pixels_px.T)
        x, y = (cv2.remap(part, columns, rows, cv2.INTER_LINEAR).ravel() for part in self.singles)
        count = len(pixels_px)
        return np.asarray(x[:count], dtype=np.float64), np.asarray(y[:count], dtype=np.float64)


class Frustum:
    """A camera's rays in a body's frame: its centre, and directions that advance by one mm of depth."""

    def __init__(self, camera_from_couch: RigidTransform, pose: Pose) -> None:
        self.camera_from_body = chain(camera_from_couch, couch_from_body(pose))
        self.rotation = self.camera_from_body.inverse.rotation
        self.center = self.camera_from_body.inverse.translation_mm
        self.height_mm = -float(self.center[2])

    def directions(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, ...]:
        """Directions (x left, y inferior, z down) of rays (x, y, 1) of the camera's frame."""
        return rotate(self.rotation, x, y, np.ones_like(x))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hit:
    """Intersections of the window's rays with the skin: depth and body coordinates [mm], each of the window's shape."""

    depth_mm: Map
    x_mm: Map
    y_mm: Map


class View:
    """A camera's picture of the body in one pose, without noise.

    Attributes
    ----------
    depth_mm
        Depth along the optical axis with the body at rest, room included, shape (H, W).
    x_mm, y_mm
        Body coordinates of each pixel's point of the body [mm], shape (H, W).
    is_body
        Pixels of the body, shape (H, W).
    window
        Rows and columns of the picture that contain all moving skin.
    is_trunk
        Pixels of the moving skin, of the window's shape.
    """

    def __init__(
        self, rays: Rays, camera_from_couch: RigidTransform, body: Body, pose: Pose, floor_mm: float = FLOOR_MM
    ) -> None:
        frustum = Frustum(camera_from_couch, pose)
        self._top_mm = np.float32(frustum.height_mm)
        center = frustum.center.astype(np.float32)
        directions = tuple(part.astype(np.float32) for part in frustum.directions(rays.x, rays.y))
        depth, height = _meet_at_rest(body, center, self._top_mm, directions)
        self.x_mm, self.y_mm = center[0] + depth * directions[0], center[1] + depth * directions[1]
        self.is_body: BoolArray = height > 1.0
        room, self.room_x_mm, self.room_y_mm, self.is_couch = _room(rays, camera_from_couch, floor_mm)
        self.depth_mm: Map = np.where(self.is_body, depth, room)
        trunk_x, trunk_y = TRUNK_HALF_MM
        moves = self.is_body & (np.abs(self.x_mm) < trunk_x - 6.0) & (np.abs(self.y_mm) < trunk_y - 6.0)
        self.window = _bounds(moves)
        self.is_trunk: BoolArray = np.ascontiguousarray(moves[self.window])
        self._center = center
        self._directions = tuple(np.ascontiguousarray(part[self.window]) for part in directions)
        self._rest_mm = np.ascontiguousarray(depth[self.window])
        self._step = self._newton_step(body)

    def meet(self, trunk_height_mm: Map) -> Hit:
        """Intersect the window's rays with the trunk at this moment; meaningless outside of ``is_trunk``."""
        dx, dy, dz = self._directions
        half_x, half_y = (np.float32(half) for half in TRUNK_HALF_MM)
        offset_x, offset_y = self._center[0] + half_x, self._center[1] + half_y
        depth = self._rest_mm.copy()
        column, row, gap = np.empty_like(depth), np.empty_like(depth), np.empty_like(depth)
        for _ in range(_FRAME_STEPS):
            np.multiply(depth, dx, out=column)
            column += offset_x
            np.multiply(depth, dy, out=row)
            row += offset_y
            height = cv2.remap(trunk_height_mm, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            np.multiply(depth, dz, out=gap)
            np.subtract(self._top_mm, gap, out=gap)
            gap -= height
            gap *= self._step
            depth += gap
        return Hit(depth_mm=depth, x_mm=self._center[0] + depth * dx, y_mm=self._center[1] + depth * dy)

    def whole_depth(self, hit: Hit) -> Map:
        """Depth of the whole picture with the trunk from ``hit`` [mm], shape (H, W)."""
        depth = self.depth_mm.copy()
        np.copyto(depth[self.window], hit.depth_mm, where=self.is_trunk)
        return depth

    def _newton_step(self, body: Body) -> Map:
        half_x, half_y = BODY_HALF_MM
        column = (self.x_mm[self.window] + np.float32(half_x)).astype(np.float32)
        row = (self.y_mm[self.window] + np.float32(half_y)).astype(np.float32)
        dx, dy, dz = self._directions
        slope = [cv2.remap(part, column, row, cv2.INTER_LINEAR) for part in body.slope]
        return np.asarray(1.0 / np.maximum(dz + slope[0] * dx + slope[1] * dy, 0.4), dtype=np.float32)


def _meet_at_rest(
    body: Body, center: Map, top_mm: np.float32, directions: tuple[Map, ...]
) -> tuple[Map, npt.NDArray[np.float32]]:
    """Intersect all rays with the resting body; a ray beside it ends at the couch's level."""
    dx, dy, dz = directions
    half_x, half_y = (np.float32(half) for half in BODY_HALF_MM)
    depth = (top_mm - np.float32(150.0)) / dz
    height = np.zeros_like(depth)
    for _ in range(_REST_STEPS):
        column, row = depth * dx + (center[0] + half_x), depth * dy + (center[1] + half_y)
        height = cv2.remap(body.height_mm, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        depth = (top_mm - height) / dz
    return depth, height


def _room(
    rays: Rays, camera_from_couch: RigidTransform, floor_mm: float
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Depth and couch coordinates of couch and floor [mm], and the pixels of the couch."""
    frustum = Frustum(camera_from_couch, Pose())
    dx, dy, dz = frustum.directions(rays.x, rays.y)
    couch = frustum.height_mm / dz
    is_couch = np.abs(frustum.center[0] + couch * dx) < COUCH_HALF_WIDTH_MM
    depth = np.where(is_couch, couch, (frustum.height_mm - floor_mm) / dz).astype(np.float32)
    return depth, frustum.center[0] + depth * dx, frustum.center[1] + depth * dy, is_couch


def _bounds(mask: BoolArray) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
