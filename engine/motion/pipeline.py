"""The frame path through the stages: find markers, register, sample the region, learn or project, measure.

Owned by one thread. It keeps the state between frames (tracked region, last coefficients, breaths and lags), so that
the stages are pure; model and reference belong to `engine.motion.learning.learner.Learner`.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from engine.calibration.camera_calibration import Calibration
from engine.core.breath import Breath, SignalChoice
from engine.core.clock import US_PER_S, Clock
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
from engine.motion.job_stages import JobStages, refusal, surface_mm
from engine.motion.learning.depth_steps import stored_steps
from engine.motion.learning.learner import FrameNeeds, Learned, Learner
from engine.motion.learning.lifecycle import LearningSetup
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.reference_history import ReferenceHistory
from engine.motion.learning.reference_transfer import RecentFrames
from engine.motion.learning.tasks import LearningStages, Outcome
from engine.motion.learning.trainer import BackgroundTrainer, Trainer
from engine.motion.learning.training_set import TrainingFrame
from engine.motion.settings import PipelineSettings
from engine.motion.stages.phase_lag import follow_lags, start_lags
from engine.motion.stages.projection import STRIDE_PX, project
from engine.motion.stages.regions import WIDE
from engine.motion.stages.roi import Aligned
from engine.motion.tracking.breath_tracker import BreathTracker, motion_from
from engine.motion.tracking.costal_line import CostalLineTracker
from engine.motion.tracking.region_tracker import DepthTable, RegionTracker, coverage_lost
from engine.motion.tracking.repeated_pictures import RepeatedPictures
from engine.motion.trust import Depths, SurfaceTrust

if TYPE_CHECKING:
    from collections.abc import Callable

# Training samples more finely than measuring, since the components are interpolated to the full grid.
LEARNING_STRIDE_PX = 2


class FollowedMotion:
    """Measures projected frames in order of time; owned by the pipeline's thread."""

    def __init__(self, settings: PipelineSettings, learner: Learner) -> None:
        self._settings, self._learner = settings, learner
        self.recent = RecentFrames()
        self.reset()

    def reset(self) -> None:
        """Forget breaths, lags and the last reference."""
        settings = self._settings
        self.breaths = BreathTracker(settings.breath_signals)
        self._last_reference: Reference | None = None
        self._lags = start_lags(settings.lag_pairs(), len(WIDE) + len(settings.points) + len(settings.named))

    def motion(
        self,
        active: PreparedModel,
        outcome: Projection,
        depths_mm: tuple[FloatArray, FloatArray],
        rays: FloatArray,
        timestamp_us: int,
    ) -> Motion:
        """Return the motion of a frame.

        Parameters
        ----------
        depths_mm
            Its depth at the nodes and of the regions [mm].
        rays
            Rays of the nodes, shape (nodes, 3).
        """
        node_depth_mm, depth_mm = depths_mm
        surface = surface_mm(rays, node_depth_mm)
        self._lags = follow_lags(self._lags, timestamp_us / US_PER_S, -depth_mm[active.regions.cells :])

        def present() -> Reference:
            """Smooth the reference at the present position over the last frames."""
            smoothed = self.recent.smoothed(active, outcome)
            smooth_surface = surface_mm(rays, active.node_depth_mm(smoothed.coefficients))
            return active.reference(smoothed.coefficients, smooth_surface, active.seen_weights.shares(smoothed.seen))

        reference, is_new = self._learner.reference.take_up(active, present)
        motion = motion_from(reference, active, outcome, surface, depth_mm, self._lags.lags)
        levels_from = self._learner.reference.levels_from
        if levels_from is not None:
            self._learner.reference.move_levels(motion_from(levels_from, active, outcome, surface, depth_mm), motion)
        last_reference, self._last_reference = self._last_reference, reference
        if self.breaths.has_reference_changed(active, is_reference_new=is_new) and last_reference is not None:
            before = motion_from(last_reference, active, outcome, surface, depth_mm)
            self.breaths.move(before, motion, is_end_exhale=self._learner.reference.is_end_exhale)
            self._learner.reference.move_levels(before, motion)
        return motion


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
    learns_after
        Whether `learn` is called once the gate has decided on a frame, for what the decision does not wait for.
    """

    def __init__(
        self,
        calibration: Calibration,
        settings: PipelineSettings,
        clock: Clock,
        trainer: Trainer[Outcome] | None = None,
        *,
        learns_after: bool = False,
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
        self._learns_after = learns_after
        self._later: Callable[[], None] | None = None
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
        self.learner.models.depth_steps = None
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
        if self._later is not None:  # work of the last frame that the caller left pending
            self.learn()
        needs = self.learner.begin_frame(frame.timestamp_us)
        found = self._find(frame)
        if isinstance(found, Lost):
            return self._measurement(frame, MeasurementState.LOST, lost=found)
        stride_px = LEARNING_STRIDE_PX if needs.is_fine else STRIDE_PX
        nodes, roi = self._tracker.region(frame, found, stride_px, has_model=needs.active is not None)
        if not self._tracker.table.is_settled:
            return self._without_model(frame, roi, found)
        if self.learner.models.depth_steps is None:
            self.learner.models.depth_steps = stored_steps(self._tracker.table.steps)
        thin = roi if roi.stride_px == STRIDE_PX else roi.thinned(STRIDE_PX)
        self._trust.observe(frame, self._repeated.thin, found, roi, thin)
        if needs.is_gathering and needs.active is None:
            self._find_costal_line(frame, found)
        if needs.takes_lost_frames:
            self._learn(roi, frame.timestamp_us, found, nodes.pixels_px, needs)
        self._followed.recent.add(thin, frame.timestamp_us)
        active = self.learner.models.active
        if active is not None:
            return self._measured(frame, active, found, nodes, roi, thin, needs)
        self._keep(roi, frame.timestamp_us, nodes.pixels_px)
        return self._without_model(frame, roi, found)

    def _measured(
        self,
        frame: RgbdFrame,
        active: PreparedModel,
        found: Markers,
        nodes: Aligned,
        roi: RoiDepth,
        thin: RoiDepth,
        needs: FrameNeeds,
    ) -> Measurement:
        """Measure a frame with a model, and learn from it unless it is doubted."""
        explained = self._explain(active, thin)
        if isinstance(explained, Lost):
            return self._lost(frame, explained, found)
        outcome, depths_mm = explained
        self._coefficients, self._projected_model = outcome.coefficients, active
        self._tracker.expect_depth(depths_mm[0])
        motion = self._followed.motion(active, outcome, depths_mm, nodes.rays, frame.timestamp_us)
        doubt = self._doubt()
        breaths = self._followed.breaths.follow(motion, frame.timestamp_us)

        def later() -> None:
            if doubt is None and needs.is_fine:
                if not needs.takes_lost_frames:
                    self._learn(roi, frame.timestamp_us, found, nodes.pixels_px, needs)
                self._keep(roi, frame.timestamp_us, nodes.pixels_px)
            if breaths:
                self.learner.follow(outcome.coefficients, motion, breaths[0], frame.timestamp_us)

        self._later = later
        if not self._learns_after:
            self.learn()
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
            self.learner.reference.forget_breaths()  # breaths from before and after a movement are not of one position
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

    def learn(self) -> None:
        """Do what the decision on the last frame does not wait for: keep it for a training, propose references."""
        later, self._later = self._later, None
        if later is not None:
            later()

    def _learn(self, roi: RoiDepth, timestamp_us: int, found: Markers, nodes_px: FloatArray, needs: FrameNeeds) -> None:
        """Learn from a frame; the first one fixes the markers' layout."""
        if self._tracker.has_layout and not needs.is_gathering:
            return
        if roi.valid.mean() < self._settings.min_valid_share:
            return
        if not self._tracker.has_layout:
            self._tracker.fix_layout(found)
        if needs.is_gathering:
            self._trust.second_estimate.gather()
            self.learner.models.learn(self._kept_frame(roi, timestamp_us, nodes_px))

    def _kept_frame(self, roi: RoiDepth, timestamp_us: int, nodes_px: FloatArray) -> TrainingFrame:
        """Return the frame as it is kept: one copy for a training and a refit."""
        if self._kept is None or self._kept[0] is not roi:
            self._kept = roi, TrainingFrame.kept(roi, timestamp_us, nodes_px)
        return self._kept[1]

    def _keep(self, roi: RoiDepth, timestamp_us: int, nodes_px: FloatArray) -> None:
        """Offer a measured or training frame for a refit, unless too little of it was seen."""

        def kept() -> TrainingFrame | None:
            is_seen = roi.valid.mean() >= self._settings.min_valid_share
            return self._kept_frame(roi, timestamp_us, nodes_px) if is_seen else None

        self.learner.keep(timestamp_us, kept)

    def _present_stages(self) -> LearningStages:
        """Return the stages of a job that starts now."""
        present = replace(self._stages, marked_split=self.marked_split, gathered=self._trust.second_estimate.gathered)
        return present.as_stages()

    @property
    def marked_split(self) -> tuple[float, float] | None:
        """Rows at which the line between thorax and abdomen marked by stickers crosses columns 0 and 199, if found."""
        return None if self._costal_line is None else self._costal_line.split

    def _find_costal_line(self, frame: RgbdFrame, found: Markers) -> None:
        """Look for the stickers on the costal line; not during a fit, whose duration would choose the pictures."""
        search = None if self._costal_line is None else self._tracker.search(frame)
        if self._costal_line is not None and search is not None:
            self._costal_line.search(frame.color, search, found.centers_px)

    # -- measuring ----------------------------------------------------------------------------------------------

    def _explain(self, active: PreparedModel, roi: RoiDepth) -> tuple[Projection, Depths] | Lost:
        """Project a frame, and ask whether its surface can be trusted; return its depths with the projection."""
        before = self._coefficients if self._projected_model is active else None
        noise_mm = self._trust.second_estimate.noise.counting(active.model.noise_mm)
        best = project(active.basis, roi, before, noise_mm)
        outcome = coverage_lost(0.0) if best is None else refusal(best, self._settings) or best
        learner = self.learner
        return self._trust.judge(
            active,
            outcome,
            noise_mm,
            is_reference_due=learner.reference.is_due,
            position_generation=learner.journal.position_generation,
        )
