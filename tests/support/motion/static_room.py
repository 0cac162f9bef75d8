"""Depth pictures of a round body on a couch over a floor, from a camera that may be lowered or tilted."""

import numpy as np

from engine.core.geometry import Intrinsics
from engine.motion.cross_check.static_scene import LEARNING_US

CAMERA = Intrinsics(width=640, height=480, fx=575.0, fy=575.0, cx=319.5, cy=239.5)
Y, X = np.mgrid[0:480, 0:640].astype(np.float64)
RAYS_X, RAYS_Y = (X - CAMERA.cx) / CAMERA.fx, (Y - CAMERA.cy) / CAMERA.fy
MARKERS_MM = np.array([[-120.0, -150.0, 850.0], [120.0, -150.0, 850.0], [120.0, 150.0, 850.0], [-120.0, 150.0, 850.0]])
STEP_US = 33_333
FRAMES = LEARNING_US // STEP_US + 2


def scene_mm(
    *,
    lowered_mm=0.0,
    couch_mm=0.0,
    couch_half_mm=300.0,
    tilt_rad=0.0,
    chest_mm=0.0,
    person=False,
    has_room=True,
    seed=1,
):
    """A round body on a couch at 1.02 m over a floor at 1.7 m; the camera is lowered, or tilted about x.

    ``couch_mm`` is how far the couch is lowered, with the body on it.
    """
    room = np.where(np.abs(RAYS_X * 1020.0) < couch_half_mm, 1020.0 + couch_mm, 1700.0)
    moved = room - lowered_mm + tilt_rad * RAYS_Y * room
    body = 850.0 + 0.002 * (X - 320.0) ** 2 - chest_mm + couch_mm - lowered_mm + tilt_rad * RAYS_Y * 850.0
    is_body = (np.abs(X - 320.0) < 130.0) & (np.abs(Y - 240.0) < 210.0)
    depth = np.where(is_body, body, moved)
    if person:
        depth[:, :144] = 700.0  # of less than half of what is seen beside the body
    if not has_room:
        depth[~is_body] = 0.0
    noise = np.random.default_rng(seed).normal(0.0, 1.5, depth.shape) * (depth / 1000.0) ** 2
    return np.clip(np.rint(depth + noise), 0, 9000).astype(np.uint16)
