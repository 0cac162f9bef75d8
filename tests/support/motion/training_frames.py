"""Gathered frames by construction, and the real stages to learn from them: no camera, no pipeline, no thread."""

from dataclasses import replace

import numpy as np

from engine.core.breath import WHOLE, SignalChoice
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, RoiDepth
from engine.core.native_process import keep_calls_in_their_thread
from engine.motion.learning.learner import Learner
from engine.motion.learning.lifecycle import LearningSetup
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.prepared_model import prepare_model
from engine.motion.learning.reference_history import ReferenceHistory
from engine.motion.learning.tasks import LearningStages
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.learning.training_set import TrainingFrame
from engine.motion.stages.projection import project
from engine.motion.stages.regions import RegionLayout
from engine.motion.tracking.breath_tracker import PastMeasurement

FRAME_US = 33_367
STRIDE_PX = 2
SHA256 = "c" * 64
FOCAL_PX = 550.0
FEW = TrainingSettings(
    min_frames=60, min_seconds=4.0, min_cycles=1, max_seconds=12.0, max_frames=200, refit_until_s=0.0
)
"""Small sets: what is tested does not depend on their size."""
FEWER = replace(FEW, min_frames=40, min_seconds=2.0, min_cycles=0)
"""One quick breath, for tests that learn many times."""
QUICK_S = 2.0

_ROWS, _COLUMNS = np.mgrid[0:350:STRIDE_PX, 0:200:STRIDE_PX].astype(np.float64)
CHEST = np.exp(-(((_ROWS - 90.0) / 90.0) ** 2) - ((_COLUMNS - 100.0) / 110.0) ** 2)
BELLY = np.exp(-(((_ROWS - 260.0) / 80.0) ** 2) - ((_COLUMNS - 100.0) / 100.0) ** 2)
REST_MM = 850.0 + 0.004 * (_COLUMNS - 100.0) ** 2 + 0.0005 * (_ROWS - 175.0) ** 2
NODES_PX = np.stack(
    np.meshgrid(np.linspace(-70.0, 70.0, NODE_COLUMNS), np.linspace(-130.0, 130.0, NODE_ROWS)), axis=-1
).reshape(-1, 2)


def breath(seconds, *, depth_mm=10.0, period_s=4.0):
    """Chest and belly excursion [mm]."""
    phase = 2.0 * np.pi * seconds / period_s
    return 0.2 * depth_mm * (1.0 - np.cos(phase - 0.3)), 0.5 * depth_mm * (1.0 - np.cos(phase))


def frame(index, *, excursion=None, shape=None, shift_mm=(0.0, 0.0, 0.0), hide=None, noise=True):
    """Frame ``index``; ``shape`` is added to the surface [mm], ``shift_mm`` moves the patient, ``hide`` makes holes."""
    chest, belly = breath(index * FRAME_US / 1e6) if excursion is None else excursion
    depth = REST_MM - chest * CHEST - belly * BELLY + shift_mm[2] + (0.0 if shape is None else shape)
    if noise:
        depth = np.rint(depth + np.random.default_rng(index).normal(0.0, 0.9, depth.shape))
    valid = np.ones(depth.shape, dtype=bool)
    if hide is not None:
        valid[hide] = False
    lateral_px = FOCAL_PX * np.array(shift_mm[:2]) / 850.0
    roi = RoiDepth(depth_mm=np.where(valid, depth, 0.0).astype(np.float32), valid=valid, stride_px=STRIDE_PX)
    return TrainingFrame(roi=roi, timestamp_us=index * FRAME_US, nodes_px=NODES_PX + lateral_px)


def vertices(nodes_px, depth_mm):
    return np.column_stack([nodes_px / FOCAL_PX * depth_mm[:, None], depth_mm])


def explain(active, roi, start):
    best = project(active.basis, roi, start)
    if best is None or best.valid_share < 0.5 or best.inlier_share < 0.6 or not best.residual_mm <= 8.0:
        return None
    return best


def prepare(model):
    return prepare_model(model, RegionLayout())


def measure_past(active):
    return PastMeasurement(active, (SignalChoice(),), explain, vertices)


STAGES = LearningStages(prepare=prepare, explain=explain, vertices=vertices, measure_past=measure_past)


class Patient:
    """A learner with a patient: offers frames, measures them as a pipeline does, keeps the notices."""

    def __init__(self, settings=FEW, *, trainer=None, match_limits=None, sha256=SHA256):
        keep_calls_in_their_thread()  # as the pipeline does
        self.learner = Learner(
            LearningSetup(
                calibration_sha256=sha256,
                settings=settings,
                match_limits=PatientMatchLimits(seconds=1.0) if match_limits is None else match_limits,
                stages=STAGES,
            ),
            InlineTrainer() if trainer is None else trainer,
            ReferenceHistory(calibration_sha256=sha256, layout=RegionLayout(), choices=(WHOLE,)),
        )
        self.index = 0
        self.notices = []

    def see(self, **surface):
        """Offer the next frame; returns motion of every region [mm], with the volume [l] last, or None."""
        seen = frame(self.index, **surface)
        self.index += 1
        self.learner.begin_frame(seen.timestamp_us)
        if self.learner.models.is_gathering:
            self.learner.models.learn(seen)
        motion = self.measured(seen)
        if motion is not None or self.learner.active is None:
            self.learner.keep(seen.timestamp_us, lambda: seen)
        self.notices += self.learner.take_notices()
        return motion

    def measured(self, seen):
        active = self.learner.active
        best = None if active is None else explain(active, seen.roi, None)
        if best is None:
            return None
        surface = vertices(seen.nodes_px, active.node_depth_mm(best.coefficients))
        shares = active.seen_weights.shares(best.is_seen)
        zero, _ = self.learner.reference.take_up(active, lambda: active.reference(best.coefficients, surface, shares))
        return np.append(
            zero.regions_mm - active.regions.model_depth_mm(best.coefficients), zero.volume_above_l(surface)
        )

    def reference(self):
        """Return the reference in use."""
        return self.learner.learned.reference

    def see_until(self, is_done, *, most=1200, **surface):
        """Offer frames until ``is_done()``; returns what was measured. A surface may be a function of the index."""
        measured = []
        for _ in range(most):
            shown = {name: part(self.index) if callable(part) else part for name, part in surface.items()}
            measured.append(self.see(**shown))
            if is_done():
                return measured
        raise AssertionError(f"not done after {most} frames: {self.learner.models.progress}")

    def learn(self, **surface):
        """Gather and fit a first model."""
        self.see_until(lambda: self.learner.active is not None, **surface)
        return self.learner.active.model

    def reported(self, kind):
        return [notice for notice in self.notices if notice.kind == kind]

    @property
    def whole(self):
        return self.learner.active.regions.cells
