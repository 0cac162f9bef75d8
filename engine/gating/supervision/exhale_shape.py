"""The shape of the chest at the end of exhale: a slow change of one part of it passes for breathing in every frame.

Cloth that swells, a belly that fills, or a growing error of the depth over half of the region is explained by a tilt of
the body, or by a shift between thorax and abdomen, which both come and go within a breath. At the end of exhale neither
is left of a breath: there they are drifts, and bounded as the level is (:mod:`engine.gating.supervision.baseline`).
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from engine.core.frames import NODE_COLUMNS, FloatArray, Measurement
from engine.core.gate_state import HoldReason
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits
from engine.gating.supervision.baseline import RETURNED
from engine.gating.supervision.patient_shift import NODES

REDISTRIBUTED_SHARE = 0.3
"""Allowed shift between thorax and abdomen, root mean square, as a share of the bound of the level: one half of the
region that rises evenly by h mm is a shift of about 0.6 h."""
KEPT_US = 15_000_000
"""An end of exhale is known when the next inhale has begun: earlier than this."""


class _Shape(NamedTuple):
    """Tilt about the axis across the body [deg] and redistribution [mm], of one frame."""

    timestamp_us: int
    tilt_deg: float
    redistributed_mm: float


class ExhaleShape:
    """Compares the ends of exhale with the reference; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._max_mm = limits.max_baseline_drift_mm
        self._kept: deque[_Shape] = deque()
        self._exhale_us: int | None = None
        self._drifted: Interruption | None = None

    def reset(self) -> None:
        """Accept the patient's present shape: the reference was set."""
        self._kept.clear()
        self._exhale_us, self._drifted = None, None

    def check(self, measurement: Measurement, *, has_reference: bool) -> Interruption | None:
        """Return the hold for a shape that has drifted; it stands until the next end of exhale."""
        if not has_reference:
            self.reset()
        motion, position, now_us = measurement.motion, measurement.position, measurement.timestamp_us
        if motion is None:
            return None  # the frame itself holds
        while self._kept and not 0 <= now_us - self._kept[0].timestamp_us <= KEPT_US:
            self._kept.popleft()
        if position is not None:
            self._kept.append(_Shape(now_us, position.tilt_deg, position.redistributed_mm))
        exhale_us = measurement.breaths[0].exhale_us if measurement.breaths else None
        if exhale_us is not None and exhale_us != self._exhale_us:
            self._exhale_us = exhale_us
            found = next((one for one in self._kept if one.timestamp_us >= exhale_us), None)
            if found is not None and self._kept[0].timestamp_us <= exhale_us:
                self._drifted = self._hold(found, _half_length_mm(motion.surface_mm))
        return self._drifted

    def _hold(self, shape: _Shape, half_length_mm: float) -> Interruption | None:
        ends_mm = abs(math.tan(math.radians(shape.tilt_deg))) * half_length_mm
        share = RETURNED if self._drifted is not None else 1.0
        allowed_mm = share * self._max_mm
        if not ends_mm <= allowed_mm:
            detail = f"at the end of exhale the body is tilted: {ends_mm:.1f} mm at the region's ends"
        elif not shape.redistributed_mm <= REDISTRIBUTED_SHARE * allowed_mm:
            allowed_mm *= REDISTRIBUTED_SHARE
            detail = f"at the end of exhale thorax and abdomen are shifted by {shape.redistributed_mm:.1f} mm"
        else:
            return None
        text = f"{detail} against the reference, {allowed_mm:.1f} allowed: look at the patient, set the reference again"
        return Interruption(HoldReason.BASELINE_DRIFTED, text)


def _half_length_mm(surface_mm: FloatArray) -> float:
    """Return the distance of the region's middle from its superior end; 0 where the surface is not known."""
    return 0.5 * float(np.linalg.norm(surface_mm[0] - surface_mm[-NODE_COLUMNS])) if len(surface_mm) == NODES else 0.0
