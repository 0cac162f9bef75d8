"""Renders the depth and colour frames of a scene.

A frame depends only on the script and its own number, not on the previous frame, so any process can render any frame.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, ColorImage, DepthImage, FloatArray
from engine.core.geometry import RigidTransform
from lab.phantom import falsifications, occluders
from lab.phantom.anatomy import BODY_HALF_MM, TRUNK_HALF_MM, Anatomy
from lab.phantom.body import Map, blur, sample_body
from lab.phantom.color import ColorCamera, blur_lens, paint_body, paint_room, paint_trunk, stick
from lab.phantom.laser import CostalStickers, LaserLight, hang_laser
from lab.phantom.rig import HEIGHT_PX, WIDTH_PX, chain, couch_from_body
from lab.phantom.scenarios import Pose
from lab.phantom.scene import Scene, Script
from lab.phantom.sensor import Holes, Sensor, Unit, cast_shadow, find_holes
from lab.phantom.truth import Grid
from lab.phantom.view import FLOOR_MM, Frustum, Rays, View

AT_REST = Pose()
BREATHING_MODES = 6
SHEET_SHOWS_MM = 0.5
"""Height from which a sheet covers the colour of the skin."""
LIMB_FROM_MM, LIMB_COMES_S = 400.0, 0.5
"""How far an arm comes, and within which time."""


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
        self._sensor = Sensor(Unit.of(scene.anatomy.build, script.departure.drift_mm), script.seed, script.sensor)
        self._color_camera = ColorCamera(scene.rig.color, script.seed, script.departure)
        self._laser = (
            LaserLight(hang_laser(scene.anatomy, scene.rig, script.volunteer), scene.color_rays, script.seed)
            if script.has_laser
            else None
        )
        self._costal = CostalStickers(scene.anatomy) if script.has_extra_markers else None
        self._depth_rays = Rays.of(scene.rig.depth)
        self._sticker_slopes = _sticker_slopes(scene.anatomy)
        self._rise = _rise_of(scene)
        # Poses come one after the other: caching the newest is enough.
        self._depth_stage = lru_cache(maxsize=3)(self._make_depth_stage)
        self._color_stage = lru_cache(maxsize=3)(self._make_color_stage)
        self._cover_after = lru_cache(maxsize=2)(self._make_cover)

    def true_depth(self, time_s: float) -> Map:
        """Depth of the whole picture without the sensor's errors [mm], shape (480, 640)."""
        stage = self._depth_stage(*self._poses(time_s))
        depth = stage.view.whole_depth(stage.view.meet(self._height(time_s)))
        for thing in self._occluders(time_s):
            depth = occluders.cover_depth(
                depth, occluders.draw(thing, self.scene.rig.depth, self.scene.rig.depth_from_couch)
            )
        return depth

    def depth_frame(self, frame: int, time_s: float) -> DepthImage:
        """Render one depth frame with the sensor's errors [mm], shape (480, 640)."""
        depth = self.true_depth(time_s)
        stage = self._depth_stage(*self._poses(time_s))
        blocked: BoolArray | None = None
        if self._occluders(time_s):
            blocked = cast_shadow(depth, self.scene.rig.depth.fx) | _is_torn(depth)
        blind = self._blind(stage.view, time_s)
        if blind is not None:
            blocked = blind if blocked is None else blocked | blind
        read = self._sensor.read(depth, stage.holes, frame=frame, time_s=time_s, blocked=blocked)
        fault, elapsed_s = self._camera_fault(time_s)
        return read if fault is None else fault.depth(read, elapsed_s, self.scene.anatomy.build.camera_mm)

    def color_frame(self, frame: int, time_s: float) -> ColorImage:
        """Render one colour frame, RGB, shape (480, 640, 3)."""
        pose, camera = self._poses(time_s)
        stage = self._color_stage(pose, camera)
        weights = self.scene.breathing.weights(time_s)
        hit = stage.view.meet(self._height(time_s))
        picture = paint_trunk(stage.picture, stage.blurred, self._lit_rgb(time_s), stage.view, hit)
        camera_from_body = Frustum(_moved(self.scene.rig.color_from_couch, camera), pose).camera_from_body
        anchors = self._anchors(time_s)
        stick(
            picture,
            self.scene.rig.color,
            self.scene.color_rays,
            camera_from_body,
            anchors,
            self._sticker_slopes,
            self._sticker_light(),
            is_ringed=self.scene.script.departure.sticker == "ringed",
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
        exposed = self._color_camera.expose(picture, frame, time_s)
        fault, _ = self._camera_fault(time_s)
        return exposed if fault is None else fault.color(exposed)

    def _camera_fault(self, time_s: float) -> tuple[falsifications.CameraFault | None, float]:
        """Return what the camera does to its pictures at this time, and since when [s]."""
        false = self.scene.script.falsification
        elapsed_s = None if false is None else false.elapsed_s(time_s)
        return (None, 0.0) if false is None or elapsed_s is None else (false.fault, elapsed_s)

    def _poses(self, time_s: float) -> tuple[Pose, Pose]:
        """Poses of the body on the couch, and of the couch before the cameras, which move together."""
        false = self.scene.script.falsification
        elapsed_s = None if false is None or false.camera is None else false.elapsed_s(time_s)
        camera = AT_REST if false is None or false.camera is None or elapsed_s is None else false.camera.pose(elapsed_s)
        return self.scene.pose(time_s), camera

    def _height(self, time_s: float) -> Map:
        """Height of the trunk's box, with a sheet on it and a rise below a blind area [mm]."""
        height = self._body.trunk_height(self.scene.breathing.weights(time_s))
        cover = self._cover(time_s)
        if cover is not None:
            height += cover + self._lag(time_s)
        share = self.scene.raised_share(time_s)
        if share:
            height += np.float32(share) * self._rise
        return height

    def _cover(self, time_s: float) -> Map | None:
        """Height of a sheet over the trunk's box [mm]; None without one."""
        false = self.scene.script.falsification
        elapsed_s = None if false is None or false.cover is None else false.elapsed_s(time_s)
        if false is None or false.cover is None or elapsed_s is None:
            return None
        return self._cover_after(false.cover, min(elapsed_s, false.cover.drawn_s(self.scene.anatomy)))

    def _lag(self, time_s: float) -> Map | np.float32:
        """How far a blanket stays behind the skin's motion since it was laid [mm]; 0 for one that lies on it."""
        false = self.scene.script.falsification
        if false is None or false.cover is None or false.cover.follows == 1.0:
            return np.float32(0.0)
        motion = self._body.trunk_height(self.scene.breathing.weights(time_s)) - self._laid_on
        elapsed_s = min(time_s - false.start_s, false.cover.drawn_s(self.scene.anatomy))
        return np.asarray((false.cover.follows - 1.0) * motion * false.cover.share(self.scene.anatomy, elapsed_s))

    @cached_property
    def _laid_on(self) -> Map:
        false = self.scene.script.falsification
        return self._body.trunk_height(self.scene.breathing.weights(0.0 if false is None else false.start_s))

    def _make_cover(self, cover: falsifications.Cover, elapsed_s: float) -> Map:
        return cover.on(self.scene.anatomy, elapsed_s)

    def _lit_rgb(self, time_s: float) -> npt.NDArray[np.uint8]:
        """Colour of the body under the lamp, with a sheet's where one lies on it."""
        false, cover = self.scene.script.falsification, self._cover(time_s)
        if false is None or false.cover is None or cover is None or not cover.any():
            return self._body.lit_rgb
        if not false.cover.has_color and not false.cover.darkens:
            return self._body.lit_rgb
        lit = self._body.lit_rgb.copy()
        top, left = (round(whole - part) for whole, part in zip(BODY_HALF_MM[::-1], TRUNK_HALF_MM[::-1], strict=True))
        box = lit[top : top + cover.shape[0], left : left + cover.shape[1]]
        if false.cover.darkens:
            share = false.cover.darkens * cover / np.float32(false.cover.height_mm)
            box[:] = np.rint(box * (1.0 - share[..., None]))
        else:
            box[cover > SHEET_SHOWS_MM] = false.cover.rgb
        return lit

    def _blind(self, view: View, time_s: float) -> BoolArray | None:
        """Pixels without a reading because of the falsification, shape (480, 640); None without one."""
        false, anatomy = self.scene.script.falsification, self.scene.anatomy
        if false is None:
            return None
        blind: list[BoolArray] = [~view.is_body] if false.hides_scene(time_s) else []
        if false.elapsed_s(time_s) is not None:
            if false.blind is not None:
                blind.append((false.blind.inside(anatomy, view.y_mm) > 0.0) & view.is_body)
            if false.rolling is not None:
                blind.append(false.rolling.inside(anatomy, view.y_mm, time_s) & view.is_body)
        return np.logical_or.reduce(blind) if blind else None

    def _anchors(self, time_s: float) -> Grid:
        """Places of the stickers (x, y, z down) in the body frame [mm], shape (4, 3)."""
        weights = self.scene.breathing.weights(time_s)
        anchors = self.scene.skin.anchors(weights)
        false = self.scene.script.falsification
        if false is not None and false.slide_mm and false.elapsed_s(time_s) is not None:
            anchors[:, 1] += false.slide_mm * self._breath_share(weights)
        elapsed_s = None if false is None or false.marker is None else false.elapsed_s(time_s)
        if false is None or false.marker is None or elapsed_s is None:
            return anchors
        return false.marker.anchors(anchors)

    def _breath_share(self, weights: FloatArray) -> float:
        """Return where a moment lies between the deepest exhale of the script, 0, and its deepest inhale, 1."""
        low, high = self._swing
        return (float(weights[:BREATHING_MODES].sum()) - low) / (high - low)

    @cached_property
    def _swing(self) -> tuple[float, float]:
        times_s = np.arange(0.0, self.scene.script.seconds, 0.1)
        sums = self.scene.breathing.weights(times_s)[:, :BREATHING_MODES].sum(axis=1)
        return float(sums.min()), float(sums.max())

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
            things.append(self._cloth_over(int(event.detail["marker"]), time_s))
        false = self.scene.script.falsification
        elapsed_s = None if false is None else false.elapsed_s(time_s)
        if false is not None and false.limb is not None and elapsed_s is not None:
            things.append(self._limb(false.limb, elapsed_s, time_s))
        hidden = None if false is None else false.hidden_marker(time_s)
        if hidden is not None:
            things.append(self._cloth_over(hidden, time_s))
        return things

    def _limb(self, limb: falsifications.Limb, elapsed_s: float, time_s: float) -> occluders.Occluder:
        away_mm = LIMB_FROM_MM * (1.0 - min(elapsed_s / LIMB_COMES_S, 1.0))
        breath_mm = limb.follows * (self._middle_mm(time_s) - self._middle_mm(0.0))
        height_mm = self.scene.anatomy.build.chest_mm + limb.over_mm + breath_mm
        return occluders.arm(limb.reach_mm + away_mm, limb.y_mm, height_mm, limb.radius_mm)

    def _middle_mm(self, time_s: float) -> float:
        """Height of the skin over the couch in the middle of the stickers [mm]."""
        return -float(self.scene.skin.anchors(self.scene.breathing.weights(time_s))[:, 2].mean())

    def _cloth_over(self, marker: int, time_s: float) -> occluders.Occluder:
        anchor = self._anchors(time_s)[marker]
        x_mm, y_mm, z_mm = couch_from_body(self.scene.pose(time_s)).apply(anchor[None])[0]
        return occluders.cloth(float(x_mm), float(y_mm), -float(z_mm))

    def _make_depth_stage(self, pose: Pose, camera: Pose = AT_REST) -> DepthStage:
        false = self.scene.script.falsification
        floor_mm = FLOOR_MM + (camera.z_mm if false is not None and false.floor_stays else 0.0)
        view = View(self._depth_rays, _moved(self.scene.rig.depth_from_couch, camera), self._body, pose, floor_mm)
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

    def _make_color_stage(self, pose: Pose, camera: Pose = AT_REST) -> ColorStage:
        view = View(self.scene.color_rays, _moved(self.scene.rig.color_from_couch, camera), self._body, pose)
        picture = paint_room(view, self.scene.script.volunteer)
        body = paint_body(self._body.lit_rgb, view.x_mm, view.y_mm)
        np.copyto(picture, body, where=view.is_body[..., None])
        return ColorStage(view=view, picture=picture, blurred=blur_lens(picture))


def _rise_of(scene: Scene) -> Map:
    """Return the whole rise below a blind area over the trunk's box [mm], of one column; 0 without one."""
    false = scene.script.falsification
    y_mm = np.arange(-TRUNK_HALF_MM[1], TRUNK_HALF_MM[1] + 0.5)[:, None]
    if false is None or false.blind is None:
        return np.zeros(y_mm.shape, dtype=np.float32)
    return np.asarray(false.blind.raised_mm * false.blind.inside(scene.anatomy, y_mm), dtype=np.float32)


def _moved(camera_from_couch: RigidTransform, camera: Pose) -> RigidTransform:
    return chain(camera_from_couch, couch_from_body(camera))


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
