"""A small breathing scene in memory: frames made by construction, exact and quick, beside the virtual volunteers."""

import cv2
import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.core.frames import RgbdFrame
from engine.core.geometry import Intrinsics, RigidTransform

CAMERA = Intrinsics(width=640, height=480, fx=550.0, fy=550.0, cx=319.5, cy=239.5)
CALIBRATION = Calibration(
    camera="scene",
    depth=CAMERA,
    color=CAMERA,
    color_from_depth=RigidTransform(rotation=np.eye(3), translation_mm=np.zeros(3)),
)
CORNERS_PX = np.array([[240.0, 110.0], [400.0, 110.0], [395.0, 380.0], [245.0, 380.0]])
FRAME_US = 33_367
_Y, _X = np.mgrid[0:480, 0:640].astype(np.float64)
CHEST = np.exp(-(((_Y - 180.0) / 90.0) ** 2) - ((_X - 320.0) / 110.0) ** 2)
BELLY = np.exp(-(((_Y - 310.0) / 80.0) ** 2) - ((_X - 320.0) / 100.0) ** 2)
REST_MM = 850.0 + 0.0006 * (_X - 320.0) ** 2


def breath(index, period_s=4.0):
    """Chest and belly excursion [mm] at frame ``index``."""
    phase = 2.0 * np.pi * index * FRAME_US / 1e6 / period_s
    return 2.0 - 2.0 * np.cos(phase - 0.3), 5.0 - 5.0 * np.cos(phase)


def picture(corners_px=CORNERS_PX):
    """A dark shirt with white discs at the corners."""
    color = np.full((480, 640, 3), 40, np.uint8)
    for x, y in corners_px:
        cv2.circle(color, (round(x * 16), round(y * 16)), round(6.5 * 16), (230, 230, 230), -1, cv2.LINE_AA, shift=4)
    return color


def numbered(color, index):
    """Return the picture with its number in a corner: no two pictures of a sensor agree in every pixel."""
    color = color.copy()
    color[0, 0] = index % 251
    return color


def depth_mm(chest_mm, belly_mm, noise=None):
    """Depth picture [mm] of the torso at the given excursions."""
    surface = REST_MM - chest_mm * CHEST - belly_mm * BELLY
    if noise is not None:
        surface = surface + noise.normal(0.0, 0.9, surface.shape)
    return np.rint(surface).astype(np.uint16)


def whole_motion_mm(index, reference_index):
    """True mean motion over the region's quadrilateral, close enough: the mean over its pixels."""
    inside = cv2.fillConvexPoly(np.zeros((480, 640), np.uint8), np.rint(CORNERS_PX).astype(np.int32), 1).astype(bool)

    def mean_mm(at):
        chest, belly = breath(at)
        return (chest * CHEST + belly * BELLY)[inside].mean()

    return mean_mm(index) - mean_mm(reference_index)


def frame(index, *, excursion=None, corners_px=CORNERS_PX, edit=None, missed=0, seed=None):
    """Frame ``index`` of the scene; ``edit`` may change the depth picture in place."""
    chest, belly = breath(index) if excursion is None else excursion
    depth = depth_mm(chest, belly, np.random.default_rng(index % 10**6 if seed is None else seed))
    if edit is not None:
        edit(depth)
    return RgbdFrame(
        index=index,
        device_index=index + 1,
        missed_frames=missed,
        timestamp_us=index * FRAME_US,
        color_timestamp_us=index * FRAME_US,
        received_ns=index * FRAME_US * 1000,
        depth_mm=depth,
        color=numbered(picture(corners_px), index),
    )
