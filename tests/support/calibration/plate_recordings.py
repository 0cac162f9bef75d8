"""Recordings of a flat plate, read by the virtual volunteers' sensor, with a wall far behind it."""

from pathlib import Path

import numpy as np

from engine.capture.oni.writer import OniWriter
from engine.core.geometry import Intrinsics
from lab.phantom.sensor import Holes, Sensor, Unit
from tests.support.calibration.camera_pair import CAMERAS

PERIOD_US = 33_400
TRUE = Unit(scale=1.013, offset_mm=-4.0)
"""What turns this unit's readings into mm: ``depth = 1.013 * reading - 4``."""


def plate_depth(
    distance_mm: float,
    *,
    tilt_deg: float = 0.0,
    bulge_mm: float = 0.0,
    fills: float = 0.7,
    camera: Intrinsics = CAMERAS.depth,
):
    """True depth of a plate that cuts the optical axis at ``distance_mm``; the wall is at 2 m."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    slope = np.tan(np.deg2rad(tilt_deg))
    depth = distance_mm / (1.0 - slope * rays[:, 0])
    radius = np.hypot(rays[:, 0], rays[:, 1])
    depth = (depth - bulge_mm * np.cos(6.0 * np.pi * np.minimum(radius, 0.5))).reshape(rows.shape)
    is_plate = (np.abs(columns / camera.width - 0.5) < fills / 2) & (np.abs(rows / camera.height - 0.5) < fills / 2)
    return np.where(is_plate, depth, 2000.0).astype(np.float32)


def record_plate(
    path: Path,
    depth_mm,
    *,
    frames: int = 60,
    seed: int = 1,
    holes: float = 0.05,
    start_s: float = 3000.0,
    end_s: float | None = None,
) -> Path:
    """Let the sensor read it; ``start_s`` is how long it has been on, ``end_s`` how long it will have been."""
    sensor = Sensor(TRUE, seed)
    height, width = depth_mm.shape
    level = np.where(np.random.default_rng(seed).random((height, width)) < holes, np.inf, -np.inf).astype(np.float32)
    still = Holes(level=level, is_edge=np.zeros((height, width), dtype=bool))
    times_s = np.linspace(start_s, start_s if end_s is None else end_s, frames)
    with OniWriter(path, depth_size=(width, height), color_size=None, depth_codec="NONE") as writer:
        for frame, time_s in enumerate(times_s):
            writer.write_depth(frame * PERIOD_US, sensor.read(depth_mm, still, frame=frame, time_s=float(time_s)))
    return path
