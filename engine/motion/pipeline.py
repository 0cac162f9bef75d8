"""The frame path through the stages: find markers, register, sample the region, learn or project, measure.

Owned by one thread. It keeps the state between frames (tracked region, last coefficients), so that the stages are pure;
model and reference belong to `engine.motion.learning.learner.Learner`.
"""

from dataclasses import replace
from typing import NamedTuple

from engine.calibration.camera_calibration import Calibration
from engine.core.breath import Breath, SignalChoice
from engine.core.clock import Clock
from engine.core.frames import (
    FloatArray,
    Lost,
    Markers,
    Measurement,
    MeasurementState,
    Motion,
    Projection,
    RgbdFrame,
    RoiDepth,
)
from engine.core.motion_model import MotionModel
from engine.core.native_process import keep_calls_in_their_thread, keep_freed_memory
from engine.motion.cross_check.cell_surface import BreathingShapes
from engine.motion.followed_motion import FollowedMotion
from engine.motion.job_stages import JobStages, refusal
from engine.motion.learning.depth_steps import stored_steps
from engine.motion.learning.learner import Learned, Learner
from engine.motion.learning.lifecycle import LearningSetup
from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.learning.reference_history import ReferenceHistory
from engine.motion.learning.tasks import LearningStages, Outcome
from engine.motion.learning.trainer import BackgroundTrainer, Trainer
from engine.motion.learning.training_set import TrainingFrame
from engine.motion.settings import PipelineSettings
from engine.motion.stages.projection import STRIDE_PX, project
from engine.motion.tracking.costal_line import CostalLineTracker
from engine.motion.tracking.region_tracker import DepthTable, RegionTracker, coverage_lost
from engine.motion.tracking.repeated_pictures import RepeatedPictures
from engine.motion.trust import SurfaceTrust

# Training samples more finely than measuring, since the components are interpolated to the full grid.
LEARNING_STRIDE_PX = 2


_Depths = tuple[FloatArray, FloatArray]
"""Depth at the nodes and of the regions [mm]."""


class LearnedInPass(NamedTuple):
    """What a pass over a recording has learned: model and reference, depth of readings, shapes of breathing."""

    learned: Learned
    table: DepthTable
    shapes: tuple[MotionModel | None, BreathingShapes | None]


class Pipeline:
    """Measures motion [mm] from frames of one calibrated camera and learns the motion model.

    Parameters
    ----------
    calibration
        Calibration of the camera whose frames are measured.
    clock
        Host clock; stamps the end of each measurement.
    trainer
        Runs fits; a background thread by default.
    """

    def __init__(
        self,
        calibration: Calibration,
        settings: PipelineSettings,
        clock: Clock,
        trainer: Trainer[Outcome] | None = None,
    ) -> None:
        keep_calls_in_their_thread()
        keep_freed_memory()
        self._calibration = calibration
        self._settings = settings
        self._clock = clock
        self._stages = JobStages(calibration=calibration, settings=settings)
        self.learner = Learner(
            LearningSetup(
                calibration_sha256=calibration.sha256,
                settings=settings.training,
                match_limits=settings.likeness,
                most_noise_mm=settings.most_noise_mm,
                stages=replace(self._stages.as_stages(), present=self._present_stages),
            ),
            BackgroundTrainer() if trainer is None else trainer,
            ReferenceHistory(
                calibration_sha256=calibration.sha256,
                layout=settings.layout(),
                choices=settings.breath_signals,
                marker_placement_mm=settings.marker_placement_mm,
            ),
        )
        self._tracker = RegionTracker(
            calibration,
            marker_diameter_mm=settings.marker_diameter_mm,
            superior_px=settings.superior_px,
            max_pair_gap_ms=settings.max_pair_gap_ms,
            max_layout_change=settings.max_layout_change,
        )
        self._repeated = RepeatedPictures()
        self._trust = SurfaceTrust(calibration)
        self._followed = FollowedMotion(settings, self.learner)
        self._coefficients: FloatArray | None = None
        self._kept: tuple[RoiDepth, TrainingFrame] | None = None
        self._projected_model: PreparedModel | None = None
        self._is_believed = True
        self._costal_line = CostalLineTracker() if settings.extra_markers else None

    def correct_baseline(self, choice: SignalChoice, by: float) -> None:
        """Apply an operator's confirmed change of a signal's baseline [mm; l for the volume]."""
        self._followed.breaths.correct(choice, by)

    def camera_returned(self) -> None:
        """Reset all state after the camera was disconnected, as it may have moved."""
        self._reset_tracking()
        self._followed.reset()
        self._trust.second_estimate.restart()
        self.learner.restart_after_disconnection()

    def camera_warmed(self) -> None:
        """Drop the reference that was set while the readings of a cold camera drifted."""
        self.learner.drop_cold_reference()

    def measure_again(self, earlier: LearnedInPass) -> None:
        """Measure a recording from its first frame with what an earlier pass has learned."""
        learned, self._tracker.table = earlier.learned, earlier.table
        self.learner.use(learned)
        self._trust.second_estimate.use(earlier.shapes)
        if learned.active is not None:
            self._tracker.expect_depth(learned.active.node_mean_mm)

    def learned_in_pass(self) -> LearnedInPass:
        """Return what this pass over a recording has learned; fits a model of all of it if its frames were kept."""
        learned = self.learner.learned
        learned = replace(learned, active=self.learner.refits.of_longest(learned.active))
        model = None if learned.active is None else learned.active.model
        return LearnedInPass(learned, self._tracker.table, (model, self._trust.second_estimate.shapes))

    def measure(self, frame: RgbdFrame) -> Measurement:
        """Measure one frame.

        Raises
        ------
        CalibrationError
            The pictures' sizes differ from the calibration's. No other content of a frame raises.
        """
        self._calibration.check_sizes(depth=frame.depth_mm.shape, color=frame.color.shape)
        self.learner.collect(frame.timestamp_us)
        found = self._find(frame)
        if isinstance(found, Lost):
            return self._measurement(frame, MeasurementState.LOST, lost=found)
        stride_px = self._stride_px(frame.timestamp_us)
        nodes, roi = self._tracker.region(frame, found, stride_px, has_model=self.learner.active is not None)
        if not self._tracker.is_settled:
            return self._without_model(frame, roi, found)
        self.learner.models.depth_steps = stored_steps(self._tracker.depth_steps)
        thin = roi.thinned(STRIDE_PX)
        self._trust.observe(frame, found, roi, thin)
        self._find_costal_line(frame, found)
        takes_lost_frames = self.learner.models.takes_lost_frames
        if takes_lost_frames:
            self._learn(roi, frame.timestamp_us, found, nodes.pixels_px)
        self._followed.recent.add(thin, frame.timestamp_us)
        active = self.learner.active
        if active is None:
            self._keep(roi, frame.timestamp_us, nodes.pixels_px)
            return self._without_model(frame, roi, found)
        explained = self._explain(active, thin)
        if isinstance(explained, Lost):
            return self._lost(frame, explained, found)
        outcome, depths_mm = explained
        self._trust.second_estimate.confirm()
        self._coefficients, self._projected_model = outcome.coefficients, active
        self._tracker.expect_depth(depths_mm[0])
        motion = self._followed.motion(active, outcome, depths_mm, nodes.rays, frame.timestamp_us)
        doubt = self._doubt()
        if doubt is None:
            self._learn(roi, frame.timestamp_us, found, nodes.pixels_px, is_taken=takes_lost_frames)
            self._keep(roi, frame.timestamp_us, nodes.pixels_px)
        breaths = self._followed.breath(motion, outcome, frame.timestamp_us)
        return self._measurement(
            frame, MeasurementState.MEASURING, motion=motion, markers=found, breaths=breaths, doubt=doubt
        )

    def _find(self, frame: RgbdFrame) -> Markers | Lost:
        """Find the markers in a new picture; an old one changes nothing that is tracked."""
        old = self._repeated.check(frame)
        if old is not None:
            return old
        found = self._tracker.find(frame)
        if isinstance(found, Lost):
            self._reset_tracking()
        return found

    def _measurement(
        self,
        frame: RgbdFrame,
        state: MeasurementState,
        *,
        motion: Motion | None = None,
        lost: Lost | None = None,
        markers: Markers | None = None,
        breaths: tuple[Breath, ...] = (),
        doubt: Lost | None = None,
    ) -> Measurement:
        return Measurement(
            frame_index=frame.index,
            timestamp_us=frame.timestamp_us,
            received_ns=frame.received_ns,
            measured_ns=self._clock.now_ns(),
            missed_frames=frame.missed_frames,
            state=state,
            motion=motion,
            lost=lost,
            markers=markers,
            training=self.learner.models.progress,
            breaths=breaths,
            position=None if motion is None else self._trust.second_estimate.position,
            evidence=None if motion is None else self._trust.second_estimate.evidence,
            queue_empty_ns=frame.queue_empty_ns,
            doubt=doubt,
        )

    def _lost(self, frame: RgbdFrame, lost: Lost, found: Markers) -> Measurement:
        """Return the measurement of a frame that the model does not explain."""
        self._coefficients = None
        self._followed.recent.reset()
        self._trust.interrupt(lost)
        return self._measurement(frame, MeasurementState.LOST, lost=lost, markers=found)

    def _doubt(self) -> Lost | None:
        """Return why the gate must not rest on a measured frame, which teaches nothing then; None without a reason."""
        doubt = self._trust.second_estimate.doubt
        if (doubt is None) is not self._is_believed:
            self._is_believed = doubt is None
            self.learner.positions.forget()  # breaths from before and after a movement are not of one position
        return doubt

    def _reset_tracking(self) -> None:
        """Reset the tracking after a frame without markers."""
        self._tracker.reset()
        self._coefficients = None
        self._followed.recent.reset()

    def _without_model(self, frame: RgbdFrame, roi: RoiDepth, found: Markers) -> Measurement:
        """Return the measurement of a frame without a model: training, or lost with too few readings."""
        if roi.valid.mean() < self._settings.min_valid_share:
            lost = coverage_lost(float(roi.valid.mean()))
            return self._measurement(frame, MeasurementState.LOST, lost=lost, markers=found)
        return self._measurement(frame, MeasurementState.TRAINING, markers=found)

    # -- learning -----------------------------------------------------------------------------------------------

    def _learn(
        self, roi: RoiDepth, timestamp_us: int, found: Markers, nodes_px: FloatArray, *, is_taken: bool = False
    ) -> None:
        """Learn from a frame, unless it was taken before."""
        if is_taken or (self._tracker.has_layout and not self.learner.models.is_gathering):
            return
        if roi.valid.mean() < self._settings.min_valid_share:
            return
        if not self._tracker.has_layout:
            self._tracker.fix_layout(found)
        if self.learner.models.is_gathering:
            self._trust.second_estimate.gather()
            self.learner.models.learn(self._kept_frame(roi, timestamp_us, nodes_px))

    def _kept_frame(self, roi: RoiDepth, timestamp_us: int, nodes_px: FloatArray) -> TrainingFrame:
        """Return the frame as it is kept: one copy for a training and a refit."""
        if self._kept is None or self._kept[0] is not roi:
            self._kept = roi, TrainingFrame.kept(roi, timestamp_us, nodes_px)
        return self._kept[1]

    def _stride_px(self, timestamp_us: int) -> int:
        is_learning = self.learner.active is None or self.learner.models.is_gathering
        return LEARNING_STRIDE_PX if is_learning or self.learner.is_kept(timestamp_us) else STRIDE_PX

    def _keep(self, roi: RoiDepth, timestamp_us: int, nodes_px: FloatArray) -> None:
        """Keep a measured or training frame for a refit."""
        if self.learner.is_kept(timestamp_us) and roi.valid.mean() >= self._settings.min_valid_share:
            self.learner.keep(self._kept_frame(roi, timestamp_us, nodes_px))

    def _present_stages(self) -> LearningStages:
        """Return the stages of a job that starts now."""
        present = replace(self._stages, marked_split=self.marked_split, gathered=self._trust.second_estimate.gathered)
        return present.as_stages()

    @property
    def marked_split(self) -> tuple[float, float] | None:
        """Rows at which the line between thorax and abdomen marked by stickers crosses columns 0 and 199, if found."""
        return None if self._costal_line is None else self._costal_line.split

    def _find_costal_line(self, frame: RgbdFrame, found: Markers) -> None:
        # Not during a fit: otherwise the pictures used would depend on the duration of the fit.
        is_wanted = self.learner.active is None and self.learner.models.is_gathering
        search = self._tracker.search(frame) if self._costal_line is not None and is_wanted else None
        if self._costal_line is not None and search is not None:
            self._costal_line.search(frame.color, search, found.centers_px)

    # -- measuring ----------------------------------------------------------------------------------------------

    def _explain(self, active: PreparedModel, roi: RoiDepth) -> tuple[Projection, _Depths] | Lost:
        """Project a frame, and ask whether its surface can be trusted; return its depths with the projection."""
        before = self._coefficients if self._projected_model is active else None
        noise_mm = self._trust.second_estimate.noise.counting(active.model.noise_mm)
        best = project(active.basis, roi, before, noise_mm)
        outcome = coverage_lost(0.0) if best is None else refusal(best, self._settings) or best
        self._trust.compare(active, is_reference_due=self.learner.reference.is_due)
        filtered = self._trust.filtered(active)
        if filtered is not None:
            return filtered
        if isinstance(outcome, Lost):
            return outcome
        depths_mm = active.depths_mm(outcome.coefficients)
        return self._trust.lost(active, depths_mm[0], self.learner.journal.position_generation) or (outcome, depths_mm)
