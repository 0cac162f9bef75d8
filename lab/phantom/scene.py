"""The scene without pictures: body, cameras, breathing, and the truth at any time.

It is built in 0.1 s, a `lab.phantom.studio.Studio`, which renders pictures, in 1 s.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from engine.qa.recorded_traces import Trace
from lab.phantom.anatomy import Anatomy
from lab.phantom.breathing import Breathing
from lab.phantom.builds import NO_DEPARTURE, Departure
from lab.phantom.falsifications import APPEAR_S, Falsification
from lab.phantom.rig import build_rig
from lab.phantom.scenarios import Pose, plan
from lab.phantom.sensor import USUAL
from lab.phantom.truth import Grid, RoiTruth, Skin, sticker_px, volume_ratio
from lab.phantom.view import Rays


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Script:
    """All parameters of a recording."""

    scenario: str
    volunteer: int
    seconds: float
    fps: float
    seed: int
    trace: Trace | None = None
    departure: Departure = NO_DEPARTURE
    has_laser: bool = False
    has_extra_markers: bool = False
    falsification: Falsification | None = None
    sensor: str = USUAL

    def rng(self, stream: int) -> np.random.Generator:
        """Random generator of one purpose, numbered by ``stream``."""
        return np.random.default_rng((self.seed, self.volunteer, stream))


class Scene:
    """Body, cameras, breathing and truth of one script."""

    def __init__(self, script: Script) -> None:
        self.script = script
        self.anatomy = Anatomy(script.volunteer, script.departure)
        self.rig = build_rig(self.anatomy.build, script.volunteer)
        self.timeline = plan(
            script.scenario,
            self.anatomy.build,
            script.seconds,
            script.rng(1),
            volume_ratio=volume_ratio(self.anatomy),
            trace=script.trace,
        )
        self.breathing = Breathing(self.timeline.signals, self.anatomy.build)
        false = script.falsification
        self.skin = Skin(self.anatomy, None if false is None else false.blind)
        self.color_rays = Rays.of(self.rig.color)
        # The body moves at most once in a recording: caching the newest poses is enough.
        self._roi_truth = lru_cache(maxsize=3)(self._make_roi_truth)

    def pose(self, time_s: float) -> Pose:
        """Pose of the body at this time."""
        false = self.script.falsification
        elapsed_s = None if false is None else false.elapsed_s(time_s)
        if false is None or false.body is None or elapsed_s is None:
            return self.timeline.pose(time_s)
        return false.body.pose(elapsed_s)

    def roi_truth(self, time_s: float) -> RoiTruth:
        """Solver of the ROI's true depth for the pose at this time."""
        return self._roi_truth(self.pose(time_s))

    def raised_share(self, time_s: float) -> float:
        """How much of the rise below a blind area has come, 0 to 1."""
        false = self.script.falsification
        elapsed_s = None if false is None or false.blind is None else false.elapsed_s(time_s)
        return 0.0 if elapsed_s is None else min(elapsed_s / APPEAR_S, 1.0)

    def markers_px(self, time_s: float) -> Grid:
        """Return true sticker centres in the colour picture [px], shape (4, 2)."""
        return sticker_px(self.rig, self.skin, self.breathing.weights(time_s), self.pose(time_s))

    def _make_roi_truth(self, pose: Pose) -> RoiTruth:
        return RoiTruth(self.rig, self.color_rays, self.skin, pose)
