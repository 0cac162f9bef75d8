"""Stretches in which the patient lies still, to learn a better model than that of the first breaths.

A session refits its model to the present stretch while that grows. A second pass over a recording uses the longest one,
and then knows breath holds and other patterns too. A patient who moves on the couch comes to lie on other pixels, whose
fixed errors differ: frames from before and after a movement in one set would teach this difference as breathing.
"""

import math
from typing import NamedTuple

import numpy as np

from engine.core.compiled import kernels
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, RoiDepth
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.learning.training_set import MAX_GAP_S, TrainingFrame, TrainingSet, Vertices

STEP_US = 100_000
"""Least time between two frames: ten a second show every breath, and finer sampling is needed for these only."""
STILL_MM = 4.0
STILL_DEG = 2.0
"""Largest shift and rotation of the region from the stretch's first frame; breathing alone makes half of that."""


class Place(NamedTuple):
    """Where the region lies in the camera's frame: its middle [mm], and the direction of its long axis [degrees]."""

    x_mm: float
    y_mm: float
    axis_deg: float

    def is_near(self, other: "Place") -> bool:
        """Return whether both places are the same but for breathing."""
        shift_mm = math.hypot(self.x_mm - other.x_mm, self.y_mm - other.y_mm)
        turn_deg = abs((self.axis_deg - other.axis_deg + 180.0) % 360.0 - 180.0)
        return shift_mm <= STILL_MM and turn_deg <= STILL_DEG


class StillStretch:
    """Collects the frames of each stretch and keeps the longest; owned by the pipeline's thread."""

    def __init__(self, settings: TrainingSettings, vertices: Vertices) -> None:
        self._settings, self._vertices = settings, vertices
        self._stretch = TrainingSet(settings, vertices, is_watched=False)
        self._longest = self._stretch
        self._place: Place | None = None
        self._last_us: int | None = None

    def is_due(self, timestamp_us: int) -> bool:
        """Return whether a frame of this time is taken; it has to be sampled as finely as a training frame."""
        return self._last_us is None or not 0 <= timestamp_us - self._last_us < STEP_US

    def add(self, frame: TrainingFrame) -> None:
        """Add a frame that is due; a movement or a gap begins another stretch."""
        place = place_of(frame, self._vertices)
        has_gap = self._last_us is not None and not 0.0 < (frame.timestamp_us - self._last_us) / 1e6 <= MAX_GAP_S
        if self._place is None or has_gap or not place.is_near(self._place):
            self._place = place
            self._stretch = TrainingSet(self._settings, self._vertices, is_watched=False)
        self._last_us = frame.timestamp_us
        self._stretch.add(frame)
        if self._stretch.seconds >= self._longest.seconds:
            self._longest = self._stretch

    @property
    def present(self) -> TrainingSet:
        """The stretch that the newest frame belongs to; empty without frames."""
        return self._stretch

    @property
    def longest(self) -> TrainingSet:
        """The longest stretch so far; empty without frames."""
        return self._longest


def place_of(frame: TrainingFrame, vertices: Vertices) -> Place:
    """Return where the region lies, by its nodes at its mean depth: holes and breathing do not move it."""
    depth_mm = mean_depth_mm(frame.roi)
    points = vertices(frame.nodes_px, np.full(len(frame.nodes_px), 0.0 if math.isnan(depth_mm) else depth_mm)).reshape(
        NODE_ROWS, NODE_COLUMNS, 3
    )
    x_mm, y_mm = (np.add.reduce(points[..., :2], axis=(0, 1)) / (NODE_ROWS * NODE_COLUMNS)).tolist()
    right_mm, down_mm = (np.add.reduce(points[-1, :, :2] - points[0, :, :2]) / NODE_COLUMNS).tolist()
    return Place(x_mm, y_mm, math.degrees(math.atan2(down_mm, right_mm)))


def mean_depth_mm(roi: RoiDepth) -> float:
    """Return the mean depth of what was seen [mm]; NaN where nothing was."""
    compiled = kernels()
    if compiled is not None:
        mean_mm: float = compiled.mean_depth(np.ascontiguousarray(roi.depth_mm), np.ascontiguousarray(roi.valid))
        return mean_mm
    return float(roi.depth_mm[roi.valid].mean(dtype=np.float64)) if roi.valid.any() else math.nan
