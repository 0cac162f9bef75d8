"""Renders the depth and colour frames of a scene.

A frame depends only on the script and its own number, not on the previous frame, so any process can render any frame.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, ColorImage, DepthImage, FloatArray
from engine.verification.phantom import occluders
from engine.verification.phantom.anatomy import BODY_HALF_MM, Anatomy
from engine.verification.phantom.body import Map, blur, sample_body
from engine.verification.phantom.color import ColorCamera, blur_lens, paint_body, paint_room, paint_trunk, stick
from engine.verification.phantom.costal import CostalStickers
from engine.verification.phantom.holes import Holes, cast_shadow, find_holes
from engine.verification.phantom.laser import LaserLight, hang_laser
from engine.verification.phantom.rig import HEIGHT_PX, WIDTH_PX, couch_from_body
from engine.verification.phantom.scenarios import Pose
from engine.verification.phantom.scene import Scene, Script
from engine.verification.phantom.sensor import Sensor, Unit
from engine.verification.phantom.view import Frustum, Rays, View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthStage:
    """Precomputed data of one pose for the depth camera: the view, and the sensor's holes."""

    view: View
    holes: Holes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColorStage:
    """Precomputed data of one pose for the colour camera: the view, and the picture at rest, sharp and blurred."""

    view: View
    picture: npt.NDArray[np.uint8]
    blurred: npt.NDArray[np.uint8]


class Studio:
    """Renders the frames of one script."""

    def __init__(self, script: Script) -> None:
        scene = Scene(script)
        self.scene = scene
        self._body = sample_body(scene.anatomy)
        self._sensor = Sensor(Unit.of(scene.anatomy.build), script.seed)
        self._color_camera = ColorCamera(scene.rig.color, script.seed)
        self._laser = (
            LaserLight(hang_laser(scene.anatomy, scene.rig, script.volunteer), scene.color_rays, script.seed)
            if script.has_laser
            else None
        )
        self._costal = CostalStickers(scene.anatomy) if script.has_extra_markers else None
        self._depth_rays = Rays.of(scene.rig.depth)
        self._sticker_slopes = _sticker_slopes(scene.anatomy)
        # The body moves at most once in a recording: caching the newest poses is enough.
        self._depth_stage = lru_cache(maxsize=3)(self._make_depth_stage)
        self._color_stage = lru_cache(maxsize=3)(self._make_color_stage)

    def true_depth(self, time_s: float) -> Map:
        """Depth of the whole picture without the sensor's errors [mm], shape (480, 640)."""
        stage = self._depth_stage(self.scene.timeline.pose(time_s))
        height = self._body.trunk_height(self.scene.breathing.weights(time_s))
        depth = stage.view.whole_depth(stage.view.meet(height))
        for thing in self._occluders(time_s):
            depth = occluders.cover_depth(
                depth, occluders.draw(thing, self.scene.rig.depth, self.scene.rig.depth_from_couch)
            )
        return depth

    def depth_frame(self, frame: int, time_s: float) -> DepthImage:
        """Render one depth frame with the sensor's errors [mm], shape (480, 640)."""
        depth = self.true_depth(time_s)
        holes = self._depth_stage(self.scene.timeline.pose(time_s)).holes
        blocked: BoolArray | None = None
        if self._occluders(time_s):
            blocked = cast_shadow(depth, self.scene.rig.depth.fx) | _is_torn(depth)
        return self._sensor.read(depth, holes, frame=frame, time_s=time_s, blocked=blocked)

    def color_frame(self, frame: int, time_s: float) -> ColorImage:
        """Render one colour frame, RGB, shape (480, 640, 3)."""
        pose = self.scene.timeline.pose(time_s)
        stage = self._color_stage(pose)
        weights = self.scene.breathing.weights(time_s)
        hit = stage.view.meet(self._body.trunk_height(weights))
        picture = paint_trunk(stage.picture, stage.blurred, self._body.lit_rgb, stage.view, hit)
        camera_from_body = Frustum(self.scene.rig.color_from_couch, pose).camera_from_body
        anchors = self.scene.skin.anchors(weights)
        stick(
            picture,
            self.scene.rig.color,
            self.scene.color_rays,
            camera_from_body,
            anchors,
            self._sticker_slopes,
            self._sticker_light(),
        )
        if self._costal is not None:
            centers_mm = self._costal.centers_mm(weights)
            slopes, light = self._costal.slopes, self._costal.light
            stick(picture, self.scene.rig.color, self.scene.color_rays, camera_from_body, centers_mm, slopes, light)
        if self._laser is not None:
            self._laser.shine(picture, stage.view, hit, frame)
        for thing in self._occluders(time_s):
            drawn = occluders.draw(thing, self.scene.rig.color, self.scene.rig.color_from_couch)
            picture = occluders.cover_color(picture, drawn, thing)
        return self._color_camera.expose(picture, frame)

    def _sticker_light(self) -> FloatArray:
        anchors = self.scene.anatomy.anchors_mm
        return np.asarray(0.98 - 0.0004 * anchors[:, 0] - 0.0002 * anchors[:, 1])

    def _occluders(self, time_s: float) -> list[occluders.Occluder]:
        things = []
        event = self.scene.timeline.event("hand", time_s)
        if event is not None:
            share = (time_s - event.start_s) / (event.end_s - event.start_s)
            things.append(occluders.hand(share, self.scene.anatomy.build.chest_mm))
        event = self.scene.timeline.event("marker_hidden", time_s)
        if event is not None:
            anchor = self.scene.skin.anchors(self.scene.breathing.weights(time_s))[int(event.detail["marker"])]
            x_mm, y_mm, z_mm = couch_from_body(self.scene.timeline.pose(time_s)).apply(anchor[None])[0]
            things.append(occluders.cloth(float(x_mm), float(y_mm), -float(z_mm)))
        return things

    def _make_depth_stage(self, pose: Pose) -> DepthStage:
        view = View(self._depth_rays, self.scene.rig.depth_from_couch, self._body, pose)
        half_x, half_y = (np.float32(half) for half in BODY_HALF_MM)
        material = cv2.remap(self._body.material, view.x_mm + half_x, view.y_mm + half_y, cv2.INTER_NEAREST)
        rng = np.random.default_rng((self.scene.script.volunteer, 8))
        field = blur(rng.standard_normal((HEIGHT_PX, WIDTH_PX), dtype=np.float32), 22.0)
        is_shiny = np.zeros((HEIGHT_PX, WIDTH_PX), np.bool_)
        for spot in self.scene.anatomy.shiny:
            away = np.hypot(view.x_mm - spot.x_mm, view.y_mm - spot.y_mm)
            is_shiny |= view.is_body & (away < spot.radius_mm)
        holes = find_holes(
            view.depth_mm,
            self.scene.rig.depth.fx,
            material=np.asarray(material, dtype=np.uint8),
            is_shiny=is_shiny,
            is_room=~view.is_body & ~view.is_couch,
            darkness=field,
            body_share=self.scene.script.departure.hole_share,
            is_body=view.is_body,
        )
        return DepthStage(view=view, holes=holes)

    def _make_color_stage(self, pose: Pose) -> ColorStage:
        view = View(self.scene.color_rays, self.scene.rig.color_from_couch, self._body, pose)
        picture = paint_room(view, self.scene.script.volunteer)
        body = paint_body(self._body.lit_rgb, view.x_mm, view.y_mm)
        np.copyto(picture, body, where=view.is_body[..., None])
        return ColorStage(view=view, picture=picture, blurred=blur_lens(picture))


def _sticker_slopes(anatomy: Anatomy) -> npt.NDArray[np.float64]:
    """Mean slope of the skin under each sticker, along x and y, shape (4, 2)."""
    x, y = anatomy.anchors_mm.T
    along_x = anatomy.trunk_height(x + 4.0, y) - anatomy.trunk_height(x - 4.0, y)
    along_y = anatomy.trunk_height(x, y + 4.0) - anatomy.trunk_height(x, y - 4.0)
    return np.asarray(np.column_stack([along_x, along_y]) / 8.0)


def _is_torn(depth_mm: Map) -> BoolArray:
    """Pixels at depth steps: the sensor has no reading at the rim of a near object."""
    span = cv2.morphologyEx(depth_mm, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    return np.asarray(span > 40.0) & (depth_mm < 900.0)
