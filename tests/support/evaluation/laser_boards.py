"""Pictures of a checkerboard with a laser's line across it, drawn for known cameras, poses and planes."""

from functools import lru_cache

import cv2
import numpy as np

from engine.calibration.laser_plane import LaserPlane
from engine.calibration.procedures.boards import Board
from engine.core.geometry import Intrinsics, RigidTransform
from lab.phantom.builds import find_build
from lab.phantom.rig import build_rig

BOARD = Board(columns=9, rows=6, square_mm=30.0)
RIG = build_rig(find_build(1), 1)
BLACK, WHITE, TABLE = 28.0, 185.0, 90.0
SIGMA_PX = 1.3
LIGHT = 230.0
FINE = 3


def laser_plane(lean_deg=38.0, skew_deg=2.0, depth_mm=850.0):
    """A plane that crosses the picture's middle, across it, at a depth."""
    lean, skew = np.deg2rad([lean_deg, skew_deg])
    normal = np.array([np.sin(skew), np.cos(lean) * np.cos(skew), np.sin(lean) * np.cos(skew)])
    return LaserPlane(
        camera=RIG.calibration.camera,
        normal=normal,
        distance_mm=float(normal[2] * depth_mm),
        rms_mm=0.0,
        pictures=0,
        calibration_sha256=RIG.calibration.sha256,
    )


def held(depth_mm, tilt_x_deg=0.0, tilt_y_deg=0.0, roll_deg=0.0, x_mm=0.0, y_mm=0.0):
    """The board's pose (camera from board) with its middle at a place before the camera."""
    turns = [
        cv2.Rodrigues(np.deg2rad(axis))[0]
        for axis in (np.array([tilt_x_deg, 0.0, 0.0]), np.array([0.0, tilt_y_deg, 0.0]), np.array([0.0, 0.0, roll_deg]))
    ]
    rotation = turns[2] @ turns[1] @ turns[0]
    middle = BOARD.points_mm.mean(axis=0)
    return RigidTransform(rotation=rotation, translation_mm=np.array([x_mm, y_mm, depth_mm]) - rotation @ middle)


# Where a board was held for a good calibration.
# None is level: edges along the pixels' rows are drawn to a third of a pixel only.
POSES = (
    held(850.0, 3.0, -4.0, roll_deg=4.0),
    held(760.0, 12.0, 2.0, roll_deg=-3.0, y_mm=70.0),
    held(930.0, -14.0, 8.0, roll_deg=7.0, y_mm=-62.0),
    held(820.0, 5.0, -18.0, roll_deg=6.0, y_mm=23.0),
    held(880.0, -4.0, 15.0, roll_deg=-5.0, x_mm=40.0, y_mm=-25.0),
)


@lru_cache(maxsize=2)
def _fine_rays(camera: Intrinsics):
    """Rays of FINE x FINE places in every pixel, shape (H * FINE, W * FINE, 3)."""
    x, y = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    rays = camera.rays(np.column_stack([x.ravel(), y.ravel()]))[:, :2].reshape(camera.height, camera.width, 2)
    size = (camera.width * FINE, camera.height * FINE)
    # Half-pixel rule of resize: sample k of FINE lies at (k + 0.5) / FINE - 0.5 of its pixel.
    fine = cv2.resize(rays, size, interpolation=cv2.INTER_LINEAR)
    return np.dstack([fine, np.ones(fine.shape[:2])])


def draw(pose, plane, camera=RIG.color, seed=1, light=LIGHT):
    """Picture of the board in a pose, lit by the plane; RGB."""
    rays = _fine_rays(camera)
    normal = pose.rotation[:, 2]
    points = rays * (float(normal @ pose.translation_mm) / (rays @ normal))[..., None]
    places = (points - pose.translation_mm) @ pose.rotation / BOARD.square_mm
    column, row = places[..., 0], places[..., 1]
    is_board = (column > -1.0) & (column < BOARD.columns) & (row > -1.0) & (row < BOARD.rows)
    is_paper = is_board | ((np.abs(column - 4.0) < 6.0) & (np.abs(row - 2.5) < 4.5))
    is_black = is_board & ((np.floor(column) + np.floor(row)) % 2 == 0)
    gray = np.where(is_black, BLACK, np.where(is_paper, WHITE, TABLE))
    away_mm = points @ plane.normal - plane.distance_mm
    down, right = np.gradient(away_mm)
    away_px = away_mm / np.maximum(np.hypot(down, right), 1e-3) / FINE
    added = light * np.exp(-0.5 * (away_px / SIGMA_PX) ** 2) * (0.35 + 0.65 * gray / 255.0)
    picture = np.dstack([gray + added, gray + 0.05 * added, gray + 0.05 * added]).astype(np.float32)
    picture = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, picture.shape)
    return np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)
