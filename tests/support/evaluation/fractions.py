"""Fractions of virtual volunteers who lie elsewhere by a known move, with markers that are attached anew.

A fraction is the exact surface of the resting body, or that of a session: sensor, breathing and a model of its own, and
the reference at the end of exhale.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from engine.core.clock import NS_PER_US, ManualClock
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, NODE_STEP, ROI_COLUMNS, ROI_ROWS, FloatArray, RgbdFrame
from engine.core.reference import ReferenceMoment
from engine.motion.learning.position_fit import COLUMNS, ROWS, body_axes
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from lab.phantom.anatomy import MODES, Anatomy
from lab.phantom.falsifications import Falsification, Move
from lab.phantom.rig import build_rig, couch_from_body
from lab.phantom.scene import Script
from lab.phantom.studio import Studio
from lab.phantom.truth import RoiTruth, Skin, _map_grid, sticker_px
from lab.phantom.view import Rays

FPS = 10.0
LONGEST_S = 40.0
LONG_AGO_S = -10.0
NO_MOVE = Move()
AT = (0.0, 0.0)


class Reattached(Anatomy):
    """A volunteer whose markers are elsewhere on the skin by ``offsets_mm`` (x, y), shape (4, 2)."""

    def __init__(self, volunteer: int, offsets_mm: FloatArray) -> None:
        self.offsets_mm = offsets_mm
        super().__init__(volunteer)

    @property
    def anchors_mm(self) -> FloatArray:
        """Sticker centres (x, y) [mm], shape (4, 2)."""
        return np.asarray(super().anchors_mm + self.offsets_mm)


@dataclass(frozen=True, kw_only=True, eq=False)
class Fraction:
    """Who lies where; ``offsets_mm`` are those of the four markers on the skin (x, y), shape (4, 2)."""

    volunteer: int
    move: Move = NO_MOVE
    offsets_mm: FloatArray = field(default_factory=lambda: np.zeros((4, 2)))
    seed: int = 1

    def resting_surface(self) -> FloatArray:
        """Return the exact surface of the resting body at the region's nodes [mm], shape (nodes, 3)."""
        anatomy = Reattached(self.volunteer, self.offsets_mm)
        rig, skin, pose = build_rig(anatomy.build, self.volunteer), Skin(anatomy), self.move.pose(np.inf)
        rows = np.minimum(np.arange(NODE_ROWS) * NODE_STEP, ROI_ROWS - 1)
        columns = np.minimum(np.arange(NODE_COLUMNS) * NODE_STEP, ROI_COLUMNS - 1)
        grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float64)
        depth_mm = RoiTruth(rig, Rays.of(rig.color), skin, pose).depth(grid, np.zeros(MODES))
        rays = rig.color.rays(_map_grid(grid, sticker_px(rig, skin, np.zeros(MODES), pose)))
        directions = rays if rays.shape[1] == 3 else np.column_stack([rays, np.ones(len(rays))])
        rotation, offset_mm = rig.color_from_depth.rotation, rig.color_from_depth.translation_mm
        directions, offset_mm = directions @ rotation, rotation.T @ offset_mm
        return np.asarray(directions * ((depth_mm + offset_mm[2]) / directions[:, 2])[:, None] - offset_mm)

    def reference_surface(self) -> FloatArray:
        """Return the surface of the reference that a session confirms at the end of exhale [mm], shape (nodes, 3)."""
        false = Falsification(start_s=LONG_AGO_S, body=self.move)
        script = Script(
            scenario="regular", volunteer=self.volunteer, seconds=LONGEST_S, fps=FPS, seed=self.seed,
            falsification=false,
        )  # fmt: skip
        studio = Studio(script)
        studio.scene.skin = Skin(Reattached(self.volunteer, self.offsets_mm))
        pipeline = Pipeline(studio.scene.rig.calibration, PipelineSettings(), ManualClock(), InlineTrainer())
        learner = pipeline.learner
        for index in range(round(LONGEST_S * FPS)):
            if any(one.moment is ReferenceMoment.END_EXHALE for one in learner.status.reference_proposals):
                learner.set_reference(ReferenceMoment.END_EXHALE)
            pipeline.measure(_frame(studio, index))
            reference = learner.learned.reference
            if learner.status.has_reference and reference is not None:
                return reference.surface_mm
        msg = "no reference was proposed"
        raise AssertionError(msg)

    def moved(self, first_mm: FloatArray) -> FloatArray:
        """Return the true shift [mm] and turn [deg] along the axes of the first surface, shape (6,)."""
        rig = build_rig(Anatomy(self.volunteer).build, self.volunteer)
        hang, body = rig.depth_from_couch, couch_from_body(self.move.pose(np.inf))
        grid = first_mm.reshape(NODE_ROWS, NODE_COLUMNS, 3)[:ROWS, :COLUMNS]
        middle_mm, axes = grid.reshape(-1, 3).mean(axis=0), body_axes(grid)
        moved_mm = hang.apply(body.apply((middle_mm[None] - hang.translation_mm) @ hang.rotation))[0]
        turned: FloatArray = cv2.Rodrigues(hang.rotation @ body.rotation @ hang.rotation.T)[0].ravel()
        return np.concatenate([axes @ (moved_mm - middle_mm), np.rad2deg(axes @ turned)])


def _frame(studio: Studio, index: int) -> RgbdFrame:
    time_s = index / FPS
    at_us = round(time_s * 1e6)
    return RgbdFrame(
        index=index,
        device_index=index + 1,
        timestamp_us=at_us,
        color_timestamp_us=at_us,
        received_ns=at_us * NS_PER_US,
        depth_mm=studio.depth_frame(index, time_s),
        color=studio.color_frame(index, time_s),
    )
