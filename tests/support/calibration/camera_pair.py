"""A pair of cameras that is known, a board before them, and what they see of it: corners, or whole pictures."""

from functools import cache

import cv2
import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.calibration.procedures.boards import Board
from engine.core.geometry import Intrinsics, RigidTransform

BOARD = Board(columns=9, rows=6, square_mm=30.0)
TURN, _ = cv2.Rodrigues(np.array([0.006, -0.009, 0.004]))
CAMERAS = Calibration(
    camera="bench",
    depth=Intrinsics(
        width=640, height=480, fx=575.2, fy=576.1, cx=316.4, cy=242.3, distortion=(-0.035, 0.03, 4e-4, -3e-4, 0.0)
    ),
    color=Intrinsics(
        width=640, height=480, fx=527.9, fy=527.1, cx=322.8, cy=236.1, distortion=(0.09, -0.2, -5e-4, 6e-4, 0.0)
    ),
    color_from_depth=RigidTransform(rotation=TURN, translation_mm=np.array([25.3, -0.4, 0.7])),
)


def board_poses(count: int, *, seed: int = 1, tilt_deg: float = 32.0) -> list[RigidTransform]:
    """Poses of the board before the depth camera: tilted every way, all over the picture, 0.6 to 1 m away."""
    rng = np.random.default_rng(seed)
    center = BOARD.points_mm.mean(axis=0)
    poses = []
    for i in range(count):
        azimuth = 2.4 * i  # the golden angle: no direction twice
        tilt = np.deg2rad(tilt_deg * (0.35 + 0.65 * rng.random()))
        rotation, _ = cv2.Rodrigues(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-0.3, 0.3)]))
        z = rng.uniform(620.0, 950.0)
        reach = np.array([0.5, 0.36]) * z - (120.0, 80.0)
        x, y = reach * rng.uniform(-0.95, 0.95, 2)
        rotation = rotation @ spin
        poses.append(RigidTransform(rotation=rotation, translation_mm=np.array([x, y, z]) - rotation @ center))
    return poses


def seen_corners(pose: RigidTransform, cameras: Calibration = CAMERAS):
    """Where both cameras see the board's corners, exactly."""
    points = pose.apply(BOARD.points_mm)
    return cameras.depth.project(points), cameras.color.project(cameras.color_from_depth.apply(points))


def draw(camera: Intrinsics, camera_from_board: RigidTransform, *, seed: int = 0, noise: float = 2.0):
    """Picture of the board, lens and all: 3 x 3 rays a pixel, a little blur, noise; uint8 (H, W)."""
    directions = _rays(camera)
    normal = camera_from_board.rotation[:, 2]
    along = (normal @ camera_from_board.translation_mm) / (directions @ normal)
    local = (directions * along[..., None] - camera_from_board.translation_mm) @ camera_from_board.rotation[:, :2]
    squares = local / BOARD.square_mm
    column, row = np.floor(squares[..., 0]), np.floor(squares[..., 1])
    is_inside = (column >= -1) & (column < BOARD.columns) & (row >= -1) & (row < BOARD.rows)
    is_border = (squares > -2.0).all(-1) & (squares < (BOARD.columns + 1.0, BOARD.rows + 1.0)).all(-1)
    light = np.where(is_inside & ((column + row) % 2 == 0), 30.0, np.where(is_border, 210.0, 110.0))
    picture = light.reshape(camera.height, 3, camera.width, 3).mean(axis=(1, 3))
    picture = cv2.GaussianBlur(picture, (0, 0), 0.6)
    picture += np.random.default_rng(seed).normal(0.0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


@cache
def _rays(camera: Intrinsics):
    offsets = (np.arange(3) - 1.0) / 3.0
    x = (np.arange(camera.width)[:, None] + offsets).ravel()
    y = (np.arange(camera.height)[:, None] + offsets).ravel()
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    return camera.rays(grid.reshape(-1, 2)).reshape(*grid.shape[:2], 3)
