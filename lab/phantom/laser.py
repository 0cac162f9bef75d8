"""The line laser of the article's section 4.5.2: a plane of light across the abdomen, as the colour camera sees it.

The laser hangs towards the volunteer's feet or head, so its plane leans against the camera's view: skin that rises by
1 mm moves the line by some 0.45 mm over the skin, which is some 0.3 px of the picture. The plane stays in the room when
the patient moves. The line is drawn where the skin is, pixel by pixel; its truth is solved on the splines of
:class:`lab.phantom.truth.Skin`, and so depends on nothing that is drawn.

The spirometer of the article's section 4.5.1: ``flow.csv``, with the faults of a real one.

It has a clock of its own, not synchronised with the camera, a drifting flow offset, and noise. Positive flow is inhale.
The truth holds its lag: an event ``t`` seconds after the first depth frame is at ``t + spirometer_lag_s`` in the file.

Two stickers at the costal margin, one on each long side of the quadrilateral, that separate thorax and abdomen.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.calibration.laser_plane import LaserPlane
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray
from lab.phantom.anatomy import MODES, Anatomy
from lab.phantom.body import Map, blur
from lab.phantom.rig import HEIGHT_PX, WIDTH_PX, Rig
from lab.phantom.scenarios import Pose
from lab.phantom.scene import Scene
from lab.phantom.truth import Grid, Skin, sticker_px
from lab.phantom.view import Frustum, Hit, Rays, View

LEAN_DEG = 24.0
WIDTH_SIGMA_PX = 1.25
# Brightness added on white skin; the core of the line saturates the sensor.
POWER = 360.0
SPECKLE = 0.12
COLUMN_STEP_PX = 4
_CORE_SHARE = 0.30
_REACH_PX = 6.0
_MARGIN_PX = 64
_STEPS = 8
RATE_HZ = 100.0
NOISE_L_PER_S = 0.012
OFFSET_L_PER_S = 0.02
GREATEST_LAG_S = 1.8
_STEP_S = 0.005
_DOWN = (0.44, 0.52)  # of the way from the superior to the inferior sticker, on the patient's right and left
_SLOPE_STEP_MM = 4.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineTruth:
    """True line at one moment: rows of the colour picture [px] and depth z in the depth camera's frame [mm], (c,)."""

    row_px: Grid
    depth_mm: Grid


def hang_laser(anatomy: Anatomy, rig: Rig, volunteer: int) -> LaserPlane:
    """Place the laser so that its line crosses the upper abdomen of the resting volunteer."""
    rng = np.random.default_rng((45, volunteer))
    y_mm, skew, lean = float(rng.uniform(35.0, 75.0)), float(rng.uniform(-2.5, 2.5)), float(rng.uniform(-2.0, 2.0))
    side = 1.0 if rng.random() < 0.5 else -1.0
    place = np.array([0.0, y_mm, -float(anatomy.trunk_height(np.zeros(1), np.array([y_mm]))[0])])
    turn, tilt = np.deg2rad(skew), np.deg2rad(LEAN_DEG + lean)
    along = np.array([np.cos(turn), np.sin(turn), 0.0])
    beam = np.array([0.0, side * np.sin(tilt), np.cos(tilt)])
    normal = rig.color_from_couch.rotation @ np.cross(along, beam)
    normal /= np.linalg.norm(normal)
    distance = float(normal @ rig.color_from_couch.apply(place[None])[0])
    return LaserPlane(
        camera=rig.calibration.camera,
        normal=normal if distance > 0.0 else -normal,
        distance_mm=abs(distance),
        rms_mm=0.0,
        pictures=0,
        calibration_sha256=rig.calibration.sha256,
    )


class LaserLight:
    """Draws the laser line into colour pictures."""

    def __init__(self, plane: LaserPlane, rays: Rays, seed: int) -> None:
        self._plane = plane
        self._seed = seed
        x, y, z = plane.normal
        self._across = (x * rays.x + y * rays.y + z).astype(np.float32)
        rng = np.random.default_rng((seed, 15))
        size = (HEIGHT_PX + _MARGIN_PX, WIDTH_PX + _MARGIN_PX)
        grains = blur(rng.standard_normal(size, dtype=np.float32), 0.7)
        self._speckle = np.maximum(1.0 + grains * np.float32(SPECKLE / grains.std()), 0.2)

    def shine(self, scene: npt.NDArray[np.uint8], view: View, hit: Hit, frame: int) -> None:
        """Add the line to a blurred scene, wherever the plane of light meets the trunk."""
        profile = self._profile(view, hit)
        lit = np.flatnonzero(profile.max(axis=1) > 0.0)
        if lit.size == 0:
            return
        rows = slice(int(lit[0]), int(lit[-1]) + 1)
        profile = profile[rows]
        patch = scene[view.window][rows]
        light = POWER * self._grains(view, rows, frame) * (0.5 + 0.5 * patch[..., 0].astype(np.float32) / 255.0)
        core = _CORE_SHARE * light * profile**4
        added = np.stack([light * profile, core, core], axis=-1)
        patch[...] = np.clip(np.rint(patch + added), 0.0, 255.0).astype(np.uint8)

    def _profile(self, view: View, hit: Hit) -> Map:
        """Brightness of the line at each pixel of the trunk's window, 0 to 1."""
        away_mm = self._across[view.window] * hit.depth_mm - np.float32(self._plane.distance_mm)
        down, right = (cv2.Sobel(away_mm, cv2.CV_32F, dx, dy, scale=0.125) for dx, dy in ((0, 1), (1, 0)))
        away_px = away_mm / np.maximum(cv2.magnitude(right, down), np.float32(0.05))
        is_near = view.is_trunk & (np.abs(away_px) < _REACH_PX)
        return np.where(is_near, np.exp(-0.5 * (away_px / WIDTH_SIGMA_PX) ** 2), np.float32(0.0)).astype(np.float32)

    def _grains(self, view: View, rows: slice, frame: int) -> Map:
        """Speckle pattern of one frame; motion by a wavelength changes it, so it is random per frame."""
        top, left = (int(value) for value in np.random.default_rng((self._seed, 16, frame)).integers(0, _MARGIN_PX, 2))
        window_rows, window_columns = view.window
        first = top + window_rows.start + rows.start
        columns = slice(left + window_columns.start, left + window_columns.stop)
        return np.asarray(self._speckle[first : first + rows.stop - rows.start, columns])


class LaserTruth:
    """Solves for the true position of the line."""

    def __init__(self, plane: LaserPlane, rig: Rig, rays: Rays, skin: Skin, columns_px: FloatArray) -> None:
        self._plane, self._rig, self._rays, self._skin = plane, rig, rays, skin
        self.columns_px = columns_px

    def line(self, weights_mm: FloatArray, pose: Pose) -> LineTruth:
        """Find the line at one moment: secant steps down each column, until the plane's point lies on the skin."""
        body_from_color = Frustum(self._rig.color_from_couch, pose).camera_from_body.inverse
        spline = self._skin.spline(weights_mm)

        def points(rows_px: FloatArray) -> FloatArray:
            x, y = self._rays.at(np.column_stack([self.columns_px, rows_px]))
            return self._plane.meet(np.column_stack([x, y, np.ones_like(x)]))

        def gap(rows_px: FloatArray) -> FloatArray:
            x, y, z = body_from_color.apply(points(rows_px)).T
            return np.asarray(-z - self._skin.height(spline, x, y))

        before = np.full(len(self.columns_px), self._start_row())
        now = before + 4.0
        gap_before, gap_now = gap(before), gap(now)
        for _ in range(_STEPS):
            slope = gap_now - gap_before
            step = np.where(np.abs(slope) > 1e-9, gap_now * (now - before) / np.where(slope == 0.0, 1.0, slope), 0.0)
            before, gap_before = now, gap_now
            now = now - np.clip(step, -20.0, 20.0)
            gap_now = gap(now)
        depth = self._rig.color_from_depth.inverse.apply(points(now))[:, 2].astype(np.float64)
        return LineTruth(row_px=now, depth_mm=depth)

    def _start_row(self) -> float:
        """Row in the middle column at which the laser plane is at the chest's depth."""
        _, y, z = self._plane.normal
        deep_mm = self._rig.color_from_couch.apply(np.array([[0.0, 0.0, -float(self._skin.anatomy.build.chest_mm)]]))
        middle_y = (self._plane.distance_mm / float(deep_mm[0, 2]) - z) / y
        return float(np.clip(middle_y * self._rig.color.fy + self._rig.color.cy, 0.0, HEIGHT_PX - 1.0))


def truth_columns(markers_px: Grid) -> Grid:
    """Columns of the picture between the stickers at which the line's truth is sampled [px]."""
    left, right = (
        max(float(markers_px[[0, 3], 0].min()), 0.0),
        min(float(markers_px[[1, 2], 0].max()), WIDTH_PX - 1.0),
    )
    return np.arange(np.ceil(left / COLUMN_STEP_PX) * COLUMN_STEP_PX, right + 1e-9, COLUMN_STEP_PX)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flow:
    """A spirometer's recording: time on its own clock [s] and flow [l/s], shapes (n,)."""

    time_s: Grid
    flow_l_per_s: Grid
    lag_s: float

    def to_csv(self) -> str:
        """Return the content of ``flow.csv``."""
        rows = (f"{time:.3f},{flow:.5f}\n" for time, flow in zip(self.time_s, self.flow_l_per_s, strict=True))
        return "time_s,flow_l_per_s\n" + "".join(rows)


def breathe_through(scene: Scene, first_frame_us: int) -> Flow:
    """Simulate the spirometer's recording of a scene."""
    rng = scene.script.rng(13)
    lag_s = round(float(rng.uniform(0.3, GREATEST_LAG_S)) * (1.0 if rng.random() < 0.5 else -1.0), 3)
    time_s = np.arange(0.0, scene.script.seconds, 1.0 / RATE_HZ)
    scene_s = time_s - lag_s + first_frame_us * 1e-6
    later, earlier = (
        scene.skin.volume_l(scene.breathing.weights(scene_s + half)) for half in (0.5 * _STEP_S, -0.5 * _STEP_S)
    )
    offset = OFFSET_L_PER_S * (float(rng.uniform(-1.0, 1.0)) + 0.3 * time_s / scene.script.seconds)
    noise = rng.normal(0.0, NOISE_L_PER_S, len(time_s))
    return Flow(time_s=time_s, flow_l_per_s=(later - earlier) / _STEP_S + offset + noise, lag_s=lag_s)


class CostalStickers:
    """Positions, slopes and brightness of the two stickers on the skin."""

    def __init__(self, anatomy: Anatomy) -> None:
        superior_right, superior_left, inferior_left, inferior_right = anatomy.anchors_mm
        sides = ((superior_right, inferior_right), (superior_left, inferior_left))
        places = [(1.0 - down) * top + down * bottom for down, (top, bottom) in zip(_DOWN, sides, strict=True)]
        self._x_mm, self._y_mm = np.array(places).T
        self._rest_mm = anatomy.trunk_height(self._x_mm, self._y_mm)
        self._modes = anatomy.modes(self._x_mm, self._y_mm)
        self.slopes = self._slopes(anatomy)
        self.light = 0.98 - 0.0004 * self._x_mm - 0.0002 * self._y_mm

    def centers_mm(self, weights_mm: FloatArray) -> Grid:
        """Centres (x, y, z down) in the body frame [mm], shape (2, 3)."""
        height = self._rest_mm + (self._modes * np.asarray(weights_mm)[:, None]).sum(axis=0)
        return np.column_stack([self._x_mm, self._y_mm, -height])

    def split_rows(self, rig: Rig, skin: Skin, pose: Pose) -> tuple[float, float]:
        """Rows at which the line through the two crosses columns 0 and 199 of the ROI grid, with the body at rest."""
        right, bottom = ROI_COLUMNS - 1.0, ROI_ROWS - 1.0
        corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]], dtype=np.float32)
        at_rest = np.zeros(MODES)
        corners_px = sticker_px(rig, skin, at_rest, pose).astype(np.float32)
        camera_from_body = Frustum(rig.color_from_couch, pose).camera_from_body
        extra_px = rig.color.project(camera_from_body.apply(self.centers_mm(at_rest)))
        grid = cv2.perspectiveTransform(extra_px[None], cv2.getPerspectiveTransform(corners_px, corners))[0]
        (column, row), (other_column, other_row) = grid.tolist()
        slope = (other_row - row) / (other_column - column)
        return row - slope * column, row + slope * (right - column)

    def _slopes(self, anatomy: Anatomy) -> Grid:
        """Mean slope of the skin under each, along x and y, shape (2, 2)."""
        x, y, step = self._x_mm, self._y_mm, _SLOPE_STEP_MM
        along_x = anatomy.trunk_height(x + step, y) - anatomy.trunk_height(x - step, y)
        along_y = anatomy.trunk_height(x, y + step) - anatomy.trunk_height(x, y - step)
        return np.asarray(np.column_stack([along_x, along_y]) / (2.0 * step))
