"""Motion of each measured frame from the reference, and what is followed from frame to frame: lags and breaths."""

from engine.core.breath import Breath
from engine.core.clock import US_PER_S
from engine.core.frames import FloatArray, Motion, Projection
from engine.motion.job_stages import surface_mm
from engine.motion.learning.learner import Learner
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.reference_transfer import RecentFrames
from engine.motion.settings import PipelineSettings
from engine.motion.stages.phase_lag import follow_lags, start_lags
from engine.motion.stages.regions import WIDE
from engine.motion.tracking.breath_tracker import BreathTracker, motion_from


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
        is_reference_new = self._learner.reference.is_due
        last_reference, reference = self._last_reference, self._reference(active, outcome, rays)
        motion = motion_from(reference, active, outcome, surface, depth_mm, self._lags.lags)
        levels_from = self._learner.positions.levels_from
        if levels_from is not None:
            self._learner.positions.move_levels(motion_from(levels_from, active, outcome, surface, depth_mm), motion)
        has_changed = self.breaths.has_reference_changed(active, is_reference_new=is_reference_new)
        if has_changed and last_reference is not None:
            before = motion_from(last_reference, active, outcome, surface, depth_mm)
            self.breaths.move(before, motion, is_end_exhale=self._learner.reference.is_end_exhale)
            self._learner.positions.move_levels(before, motion)
        self._last_reference = reference
        return motion

    def breath(self, motion: Motion, outcome: Projection, timestamp_us: int) -> tuple[Breath, ...]:
        """Return the breath of each signal; the learner follows the first."""
        breaths = self.breaths.follow(motion, timestamp_us)
        if breaths:
            self._learner.follow(outcome.coefficients, motion, breaths[0], timestamp_us)
        return breaths

    def _reference(self, active: PreparedModel, outcome: Projection, rays: FloatArray) -> Reference:
        """Return the reference; one at the present position is smoothed over the last frames."""

        def present() -> Reference:
            smoothed = self.recent.smoothed(active, outcome)
            smooth_surface = surface_mm(rays, active.node_depth_mm(smoothed.coefficients))
            return active.reference(smoothed.coefficients, smooth_surface, active.seen_weights.shares(smoothed.seen))

        return self._learner.take_up_reference(active, present)
