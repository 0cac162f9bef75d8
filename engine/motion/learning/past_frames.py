"""Frames from before the first model, of which a reference is proposed as soon as that model is in use.

The pipeline keeps ten frames a second while there is no model, also during the fit. Behind the fit, the trainer's
thread measures those of the training as live frames are, and feeds them to the positions that are proposed: the same
rules hold for both. The few of the fit itself follow in the pipeline's thread, some with each live frame, so that no
gap remains before the first frame that the model measures. The result depends on the frames alone, not on how long the
fit took: a session replays from its tape.

Stretches in which the patient lies still, to learn a better model than that of the first breaths.

A session refits its model to the present stretch while that grows. A second pass over a recording uses the longest one,
and then knows breath holds and other patterns too. A patient who moves on the couch comes to lie on other pixels, whose
fixed errors differ: frames from before and after a movement in one set would teach this difference as breathing.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from engine.core.compiled import FramePath
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, RoiDepth
from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.learning.reference_proposals import MAX_AGE_US, MAX_GAP_US, PastMotion, ReferenceProposals
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.learning.training_set import MAX_GAP_S, TrainingFrame, TrainingSet, Vertices

STEP_US = 100_000
"""Least time between two frames: ten a second show every breath, and finer sampling is needed for these only."""
STILL_MM = 4.0
STILL_DEG = 2.0
"""Largest shift and rotation of the region from the stretch's first frame; breathing alone makes half of that."""
FOLLOWED_AT_ONCE = 3
"""Past frames that are measured with a live one: each takes about a millisecond, and ten a second arrive."""


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
    compiled = FramePath.kernels
    if compiled is not None:
        mean_mm: float = compiled.mean_depth(np.ascontiguousarray(roi.depth_mm), np.ascontiguousarray(roi.valid))
        return mean_mm
    return float(roi.depth_mm[roi.valid].mean(dtype=np.float64)) if roi.valid.any() else math.nan


class Stretch(NamedTuple):
    """Frames without a gap or a movement between them; ``number`` counts the stretches."""

    number: int = 0
    frames: tuple[TrainingFrame, ...] = ()


class PastFrames:
    """Keeps the last frames in which the patient lay still; owned by the pipeline's thread."""

    def __init__(self, vertices: Vertices) -> None:
        self._vertices = vertices
        self._place: Place | None = None
        self.stretch = Stretch()

    def is_due(self, timestamp_us: int) -> bool:
        """Return whether a frame of this time is kept; it has to be sampled as finely as a training frame."""
        frames = self.stretch.frames
        return not frames or not 0 <= timestamp_us - frames[-1].timestamp_us < STEP_US

    def add(self, frame: TrainingFrame) -> None:
        """Keep a frame that is due; a gap or a movement drops those before it."""
        place, now_us = place_of(frame, self._vertices), frame.timestamp_us
        last_us = self.stretch.frames[-1].timestamp_us if self.stretch.frames else now_us - 1
        if not 0 < now_us - last_us <= MAX_GAP_US or (self._place is not None and not place.is_near(self._place)):
            self.clear()
        self._place = self._place or place
        kept = tuple(one for one in self.stretch.frames if now_us - one.timestamp_us <= MAX_AGE_US)
        self.stretch = self.stretch._replace(frames=(*kept, frame))

    def clear(self) -> None:
        """Drop all frames: the patient or the camera may be elsewhere."""
        self._place = None
        self.stretch = Stretch(number=self.stretch.number + 1)


class PastBreaths:
    """Finds the positions of past frames; owned by one thread at a time."""

    def __init__(self, active: PreparedModel, measure: Callable[[TrainingFrame], PastMotion | None]) -> None:
        self._active, self._measure = active, measure
        self._followed = Stretch()
        self.proposals = ReferenceProposals()

    def follow(self, stretch: Stretch, most: int | None = None) -> bool:
        """Follow the frames that were not yet, ``most`` of them; return whether none is left.

        Those before a gap or a movement are forgotten.
        """
        if stretch.number != self._followed.number:
            self.proposals.clear()
            self._followed = Stretch(number=stretch.number)
        since_us = self._followed.frames[-1].timestamp_us if self._followed.frames else -math.inf
        waiting = [frame for frame in stretch.frames if frame.timestamp_us > since_us]
        for frame in waiting[:most]:
            measured = self._measure(frame)
            if measured is not None:
                self.proposals.follow(
                    self._active, measured.coefficients, measured.motion, measured.breath, frame.timestamp_us
                )
                self.proposals.measured_from = measured.reference
            self._followed = self._followed._replace(frames=(frame,))
        return len(waiting) <= len(waiting[:most])


class PastFollower:
    """Follows the frames from before the first model behind its fit; owned by the pipeline's thread.

    ``is_following`` is whether some may wait: an attribute, since every frame reads it.
    """

    def __init__(self, vertices: Vertices) -> None:
        self._frames = PastFrames(vertices)
        self._breaths: PastBreaths | None = None
        self.is_following = False

    @property
    def stretch(self) -> Stretch:
        """The frames from before the first model."""
        return self._frames.stretch

    def clear(self) -> None:
        """Drop those frames."""
        self._frames.clear()

    def forget(self) -> None:
        """Follow them no further: the patient or the camera may be elsewhere."""
        self._breaths, self.is_following = None, False

    def is_due(self, timestamp_us: int, *, has_model: bool) -> bool:
        """Whether a frame of this time is kept: without a model, and until those of the first fit are followed."""
        return (not has_model or self.is_following) and self._frames.is_due(timestamp_us)

    def keep(self, frame: TrainingFrame, *, has_model: bool) -> None:
        """Keep a frame that is due."""
        if self.is_due(frame.timestamp_us, has_model=has_model):
            self._frames.add(frame)

    def begin(self, breaths: PastBreaths | None) -> None:
        """Follow the frames that arrived during the first fit; other models have none."""
        self._breaths, self.is_following = breaths, breaths is not None
        if breaths is None:
            self._frames.clear()

    def follow(self) -> ReferenceProposals | None:
        """Follow some of those frames; return their positions behind the last one, and None before."""
        breaths = self._breaths
        if breaths is None or not breaths.follow(self._frames.stretch, FOLLOWED_AT_ONCE):
            return None
        self.forget()
        self._frames.clear()
        return breaths.proposals
