"""A chest made of one sloped plane, a laser's line drawn on it, and what a perfect Tidegate would say of it."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq

from engine.calibration.camera_calibration import Calibration
from engine.calibration.laser_plane import LaserPlane
from engine.core.frames import (
    Lost,
    LostReason,
    Markers,
    Measurement,
    MeasurementState,
    Motion,
    Projection,
    RgbdFrame,
)
from engine.core.geometry import Intrinsics, RigidTransform

CELL_PX = 5
CAMERA = Intrinsics(width=320, height=320, fx=300.0, fy=300.0, cx=160.0, cy=160.0)
CALIBRATION = Calibration(
    camera="flat",
    depth=CAMERA,
    color=CAMERA,
    color_from_depth=RigidTransform(rotation=np.eye(3), translation_mm=np.zeros(3)),
)
LEAN = np.deg2rad(40.0)
PLANE = LaserPlane(
    camera="flat",
    normal=np.array([0.0, np.cos(LEAN), np.sin(LEAN)]),
    distance_mm=float(np.sin(LEAN) * 800.0),
    rms_mm=0.0,
    pictures=0,
    calibration_sha256=CALIBRATION.sha256,
)
TURNED_PLANE = replace(PLANE, normal=PLANE.normal[[1, 0, 2]])
TOP_PX, BOTTOM_PX, LEFT_PX, RIGHT_PX = 40.0, 280.0, 100.0, 220.0
CORNERS = np.array([[LEFT_PX, TOP_PX], [RIGHT_PX, TOP_PX], [RIGHT_PX, BOTTOM_PX], [LEFT_PX, BOTTOM_PX]])
PERIOD_US = 33_333


@dataclass(frozen=True)
class Chest:
    """Depth [mm] is ``depth_mm`` at grid row 175 and ``slope`` more with every row."""

    depth_mm: float
    slope: float = 0.0

    def at(self, row):
        return self.depth_mm + self.slope * (row - 175.0)

    @property
    def line_px(self):
        """Row of the picture at which the plane of light meets the chest."""
        return brentq(self._gap, TOP_PX - 60.0, BOTTOM_PX + 60.0)

    def _gap(self, v):
        ray = np.array([0.0, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        return self.at(row_of(v)) * float(ray @ PLANE.normal) - PLANE.distance_mm

    def cells(self):
        rows = np.arange(0, 350, CELL_PX) + (CELL_PX - 1) / 2
        return np.repeat(self.at(rows)[:, None], 200 // CELL_PX, axis=1)


def row_of(v_px):
    """Grid row of a row of the picture."""
    return (v_px - TOP_PX) / (BOTTOM_PX - TOP_PX) * 349.0


@lru_cache(maxsize=512)
def picture(chest, *, has_line=True):
    away = np.arange(320.0)[:, None] - (chest.line_px if has_line else -50.0)
    column = np.array([40.0, 46.0, 60.0]) + np.exp(-0.5 * (away / 1.3) ** 2) * np.array([185.0, 15.0, 15.0])
    return np.repeat(np.rint(column).astype(np.uint8)[:, None], 320, axis=1)


def frame(index, chest, *, color_us=None, has_line=True, is_turned=False):
    """A frame whose colour picture shows ``chest``; ``is_turned`` swaps the picture's sides."""
    drawn = picture(chest, has_line=has_line)
    time_us = index * PERIOD_US
    return RgbdFrame(
        index=index,
        device_index=index,
        timestamp_us=time_us,
        color_timestamp_us=time_us if color_us is None else color_us,
        received_ns=0,
        depth_mm=np.zeros((320, 320), np.uint16),
        color=np.ascontiguousarray(drawn.transpose(1, 0, 2)) if is_turned else drawn,
    )


def measured(index, chest, reference, *, is_turned=False):
    """Tidegate's measurement, without a fault."""
    motion = Motion(
        whole_mm=0.0,
        thorax_mm=0.0,
        abdomen_mm=0.0,
        volume_l=0.0,
        regions_mm=reference.cells() - chest.cells(),
        regions_depth_mm=chest.cells(),
        points_mm=np.zeros(0),
        projection=Projection(
            beta=np.zeros(3), coefficients=np.zeros(3), residual_mm=0.0, valid_share=1.0, inlier_share=1.0
        ),
    )
    return replace(unmeasured(index, is_turned=is_turned), state=MeasurementState.MEASURING, motion=motion)


def unmeasured(index, *, is_turned=False):
    """A frame of the training."""
    return Measurement(
        frame_index=index,
        timestamp_us=index * PERIOD_US,
        received_ns=0,
        measured_ns=0,
        missed_frames=0,
        state=MeasurementState.TRAINING,
        markers=Markers(centers_px=(CORNERS[:, ::-1] if is_turned else CORNERS).copy()),
    )


def lost(index):
    """A frame in which a marker was hidden."""
    return replace(
        unmeasured(index),
        state=MeasurementState.LOST,
        markers=None,
        lost=Lost(reason=LostReason.MARKER_LOST, detail="hidden"),
    )
