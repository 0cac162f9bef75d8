"""How far the patient has moved on the couch since the zero was set: the four markers, in the depth camera's frame.

Breathing lifts the markers towards the camera, and tips their plane about the axis across the body where the abdomen
rises more than the thorax. Neither is looked at. What breathing does not do is carry all four along the couch, turn
them on it, or roll them about the body's long axis.
"""

import math
from typing import NamedTuple

import numpy as np

from engine.frames import FloatArray, Motion
from engine.limits import GateLimits
from engine.permits import HoldReason
from engine.stages.gate import Interruption
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS

NODES = NODE_ROWS * NODE_COLUMNS
CORNERS = (0, NODE_COLUMNS - 1, NODES - 1, NODES - NODE_COLUMNS)
"""Nodes of the surface at the markers: superior right, superior left, inferior left, inferior right."""


class Movement(NamedTuple):
    """Along the couch [mm]; on the couch and about the body's long axis, whichever is more [deg]."""

    shift_mm: float
    turn_deg: float


class PatientShift:
    """Remembers where the markers were at the zero; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._zero_mm: FloatArray | None = None

    def forget(self) -> None:
        """Take the next measured frame for the position: the zero is set anew."""
        self._zero_mm = None

    def look(self, motion: Motion | None, *, has_zero: bool) -> Interruption | None:
        """Return the hold where the patient lies elsewhere; a model that took over with the zero changes nothing."""
        if not has_zero:
            self.forget()
            return None
        if motion is None or len(motion.surface_mm) != NODES:
            return None  # not measured: the frame itself holds
        markers_mm = np.asarray(motion.surface_mm[list(CORNERS)], dtype=np.float64)
        if self._zero_mm is None:
            self._zero_mm = markers_mm
            return None
        return self._judge(movement_of(self._zero_mm, markers_mm))

    def _judge(self, moved: Movement) -> Interruption | None:
        limits = self._limits
        if not moved.shift_mm <= limits.max_shift_mm:
            detail = f"moved {moved.shift_mm:.1f} mm along the couch, {limits.max_shift_mm:g} allowed"
            return Interruption(HoldReason.PATIENT_SHIFTED, detail)
        if not moved.turn_deg <= limits.max_turn_deg:
            detail = f"turned by {moved.turn_deg:.1f} degrees, {limits.max_turn_deg:g} allowed"
            return Interruption(HoldReason.PATIENT_SHIFTED, detail)
        return None


def movement_of(zero_mm: FloatArray, now_mm: FloatArray) -> Movement:
    """Return how far four markers have moved, seen in the plane they lay in.

    Parameters
    ----------
    zero_mm, now_mm
        The markers, superior right, superior left, inferior left, inferior right, in the depth camera's frame [mm],
        shape (4, 3).
    """
    axes = _body_axes(zero_mm)
    middle_mm = zero_mm.mean(axis=0)
    before, now = (zero_mm - middle_mm) @ axes, (now_mm - middle_mm) @ axes
    offset_mm = now.mean(axis=0)
    turned = now - offset_mm
    cross = float((before[:, 0] * turned[:, 1] - before[:, 1] * turned[:, 0]).sum())
    along = float((before[:, :2] * turned[:, :2]).sum())
    lift_mm = turned[:, 2] - before[:, 2]
    left_over_right_mm = float(lift_mm[1] + lift_mm[2] - lift_mm[0] - lift_mm[3]) / 2.0
    width_mm = float(before[1, 0] + before[2, 0] - before[0, 0] - before[3, 0]) / 2.0
    turns_rad = (math.atan2(cross, along), math.atan2(left_over_right_mm, width_mm))
    turn_deg = math.nan if any(map(math.isnan, turns_rad)) else max(abs(math.degrees(turn)) for turn in turns_rad)
    return Movement(shift_mm=math.hypot(*offset_mm[:2]), turn_deg=turn_deg)


def _body_axes(markers_mm: FloatArray) -> FloatArray:
    """Return unit vectors across the body, along it, and out of the markers' plane, as columns, shape (3, 3)."""
    superior_right, superior_left, inferior_left, inferior_right = markers_mm
    along = inferior_left + inferior_right - superior_left - superior_right
    across = superior_left + inferior_left - superior_right - inferior_right
    along = along / np.linalg.norm(along)
    normal = np.cross(across, along)
    normal = normal / np.linalg.norm(normal)
    return np.stack([np.cross(along, normal), along, normal], axis=1)
