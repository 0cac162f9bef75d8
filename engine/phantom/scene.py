"""What is in the room, without any picture of it: the person, the cameras, the breathing, and the truth of each moment.

It takes a tenth of a second to make, where :class:`engine.phantom.studio.Studio` takes one.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from engine.phantom.anatomy import Anatomy
from engine.phantom.breathing import Breathing
from engine.phantom.builds import NO_DEPARTURE, Departure
from engine.phantom.rig import build_rig
from engine.phantom.scenarios import Pose, plan
from engine.phantom.traces import Trace
from engine.phantom.truth import Grid, RoiTruth, Skin, sticker_px, volume_ratio
from engine.phantom.view import Rays


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Script:
    """All that a recording follows from."""

    scenario: str
    volunteer: int
    seconds: float
    fps: float
    seed: int
    trace: Trace | None = None
    departure: Departure = NO_DEPARTURE
    has_laser: bool = False
    has_extra_markers: bool = False

    def rng(self, stream: int) -> np.random.Generator:
        """Random numbers of one purpose."""
        return np.random.default_rng((self.seed, self.volunteer, stream))


class Scene:
    """One script, come to life."""

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
        self.skin = Skin(self.anatomy)
        self.color_rays = Rays.of(self.rig.color)
        # A body lies still but for one movement: the newest poses are enough.
        self._roi_truth = lru_cache(maxsize=3)(self._make_roi_truth)

    def roi_truth(self, time_s: float) -> RoiTruth:
        """Truth of the pose at this time."""
        return self._roi_truth(self.timeline.pose(time_s))

    def markers_px(self, time_s: float) -> Grid:
        """Return true sticker centres in the colour picture [px], shape (4, 2)."""
        return sticker_px(self.rig, self.skin, self.breathing.weights(time_s), self.timeline.pose(time_s))

    def _make_roi_truth(self, pose: Pose) -> RoiTruth:
        return RoiTruth(self.rig, self.color_rays, self.skin, pose)
