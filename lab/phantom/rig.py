"""The cameras over the couch: poses, intrinsics, and the calibration file made for them.

Couch frame: the body frame with z = -h, so x to the patient's left, y inferior, z down; it is right-handed, and a
camera that hangs level with its picture's top at the head has the same axes.
"""

from dataclasses import dataclass

import numpy as np

from engine.calibration.camera_calibration import Calibration, DepthCorrection, Disparity
from engine.core.frames import FloatArray
from engine.core.geometry import Intrinsics, RigidTransform
from lab.phantom.builds import Build
from lab.phantom.scenarios import Pose

WIDTH_PX, HEIGHT_PX = 640, 480
# The infrared projector sits beside the depth camera, towards positive x.
PROJECTOR_BASELINE_MM = 75.0
ZERO_PLANE_PX_SIZE = 0.1052
STEPS_A_MM = 36_000.0 / ZERO_PLANE_PX_SIZE
# Rotations of a body are about the middle of its chest's surface.
_PIVOT_MM = np.array([0.0, 0.0, -200.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """True parameters of both cameras, and the calibration with the errors of a real one."""

    depth: Intrinsics
    color: Intrinsics
    color_from_depth: RigidTransform
    depth_from_couch: RigidTransform
    calibration: Calibration

    @property
    def color_from_couch(self) -> RigidTransform:
        """Pose of the colour camera."""
        return chain(self.color_from_depth, self.depth_from_couch)


def build_rig(build: Build, volunteer: int) -> Rig:
    """Place the cameras over one volunteer; each volunteer has a camera unit of its own."""
    rng = np.random.default_rng((85, volunteer))
    depth = _camera(rng, focal_px=575.8, k1=-0.032, k2=0.025)
    color = _camera(rng, focal_px=527.5, k1=0.085, k2=-0.19)
    angles = np.deg2rad(rng.uniform(-0.5, 0.5, 3))
    pose = RigidTransform(rotation=_rotation(*angles), translation_mm=np.array([25.0, *rng.uniform(-0.8, 0.8, 2)]))
    # A depth correction measured on a flat plate removes most of the unit's error, not all of it.
    correction = DepthCorrection(
        scale=round(build.depth_scale + float(rng.uniform(-0.002, 0.002)), 5),
        offset_mm=round(build.depth_offset_mm + float(rng.uniform(-1.0, 1.0)), 3),
    )
    calibration = Calibration(
        camera=f"virtual Xtion {volunteer:02d}",
        depth=depth,
        color=color,
        color_from_depth=pose,
        depth_correction=correction,
        disparity=Disparity(baseline_mm=PROJECTOR_BASELINE_MM, step_px=depth.fx * PROJECTOR_BASELINE_MM / STEPS_A_MM),
    )
    return Rig(
        depth=depth,
        color=color,
        color_from_depth=pose,
        depth_from_couch=_hang(build, rng),
        calibration=calibration,
    )


def couch_from_body(pose: Pose) -> RigidTransform:
    """Transform of a pose: a rotation about the middle of the chest's surface, then a translation."""
    rotation = _rotation(pose.tilt_rad, pose.roll_rad, pose.turn_rad)
    shift_mm = np.array([pose.x_mm, pose.y_mm, pose.z_mm])
    return RigidTransform(rotation=rotation, translation_mm=shift_mm + _PIVOT_MM - rotation @ _PIVOT_MM)


def chain(outer: RigidTransform, inner: RigidTransform) -> RigidTransform:
    """Compose two transforms: ``inner`` first, then ``outer``."""
    return RigidTransform(
        rotation=outer.rotation @ inner.rotation,
        translation_mm=outer.rotation @ inner.translation_mm + outer.translation_mm,
    )


def rotate(rotation: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, ...]:
    """Rotate element by element: the same bits however many threads the linear algebra library has."""
    return tuple(row[0] * x + row[1] * y + row[2] * z for row in rotation)


def _camera(rng: np.random.Generator, *, focal_px: float, k1: float, k2: float) -> Intrinsics:
    focal = focal_px + float(rng.uniform(-3.0, 3.0))
    spread = rng.uniform(-1.0, 1.0, 6)
    return Intrinsics(
        width=WIDTH_PX,
        height=HEIGHT_PX,
        fx=round(focal, 3),
        fy=round(focal * (1.0 + 0.002 * float(spread[0])), 3),
        cx=round(319.5 + 5.0 * float(spread[1]), 3),
        cy=round(239.5 + 5.0 * float(spread[2]), 3),
        distortion=(
            round(k1 + 0.01 * float(spread[3]), 5),
            round(k2 + 0.02 * float(spread[4]), 5),
            round(0.0008 * float(spread[5]), 6),
            round(-0.0006 * float(spread[0]), 6),
            0.0,
        ),
    )


def _hang(build: Build, rng: np.random.Generator) -> RigidTransform:
    rotation = _rotation(*np.deg2rad([build.tilt_x_deg, build.tilt_y_deg, build.roll_deg]))
    axis = rotation[2]
    target = np.array([float(rng.uniform(-12, 12)), float(rng.uniform(-15, 8)), -build.chest_mm])
    center = target - axis * (build.camera_mm / axis[2])
    return RigidTransform(rotation=rotation, translation_mm=-rotation @ center)


def _rotation(x_rad: float, y_rad: float, z_rad: float) -> FloatArray:
    """Rotate about x first, then y, then z."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([x_rad, y_rad, z_rad]), np.sin([x_rad, y_rad, z_rad])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)
