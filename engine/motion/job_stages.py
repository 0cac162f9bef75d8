"""The functions of the pipeline that training jobs need, as a value that a job takes to another process."""

from dataclasses import dataclass, replace

from engine.calibration.camera_calibration import Calibration
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, NODE_STEP, FloatArray, Lost, LostReason, Projection, RoiDepth
from engine.core.motion_model import MotionModel
from engine.core.sentences import say
from engine.motion.cross_check.cell_surface import GatheredSurfaces
from engine.motion.learning.prepared_model import PreparedModel, prepare_model
from engine.motion.learning.tasks import LearningStages
from engine.motion.settings import PipelineSettings
from engine.motion.stages.projection import project
from engine.motion.stages.surface import node_surface_mm
from engine.motion.tracking.breath_tracker import PastMeasurement
from engine.motion.tracking.region_tracker import coverage_lost

MARKERS_BETWEEN_NODES = 1.0 - 1.0 / NODE_STEP


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JobStages:
    """What jobs compute with.

    Attributes
    ----------
    marked_split
        The line between thorax and abdomen marked by stickers, as in `PipelineSettings.split`; None without one.
    gathered
        Surfaces that the independent checks learn the shapes of breathing from; None where they need none.
    """

    calibration: Calibration
    settings: PipelineSettings
    marked_split: tuple[float, float] | None = None
    gathered: GatheredSurfaces | None = None

    def as_stages(self) -> LearningStages:
        """Return them as the learner calls them."""
        return LearningStages(
            prepare=self.prepare, explain=self.explain, vertices=self.vertices, measure_past=self.measure_past
        )

    def prepare(self, model: MotionModel) -> PreparedModel:
        """Prepare a model for measuring."""
        active = prepare_model(model, self.settings.layout(self.marked_split))
        return active if self.gathered is None else replace(active, beside=self.gathered.learn())

    def explain(self, active: PreparedModel, roi: RoiDepth, start: FloatArray | None) -> Projection | None:
        """Project a region with the limits of a measured frame."""
        best = project(active.basis, roi, start)
        return best if best is not None and refusal(best, self.settings) is None else None

    def measure_past(self, active: PreparedModel) -> PastMeasurement:
        """Measure the first gated signal of frames from before a model."""
        return PastMeasurement(active, self.settings.breath_signals, self.explain, self.vertices)

    def vertices(self, nodes_px: FloatArray, depth_mm: FloatArray) -> FloatArray:
        """Compute the points at the nodes [mm], shape (nodes, 3)."""
        return surface_mm(self.calibration.depth.rays(nodes_px)[:, :2], depth_mm)


def refusal(best: Projection, settings: PipelineSettings) -> Lost | None:
    """Return the loss if a projection exceeds the settings' limits, otherwise None."""
    if best.valid_share < settings.min_valid_share:
        return coverage_lost(best.valid_share)
    if best.inlier_share < settings.min_inlier_share or not best.residual_mm <= settings.max_residual_mm:
        return Lost(
            reason=LostReason.RESIDUAL_HIGH,
            detail=say(
                "residual {residual_mm:.1f} mm, {inlier_share:.0%} of the pixels explained",
                residual_mm=best.residual_mm,
                inlier_share=best.inlier_share,
            ),
        )
    return None


def surface_mm(rays: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Return the vertices at the nodes' depth [mm]; the last nodes are moved from a pixel beyond to the markers."""
    return node_surface_mm(rays, depth_mm, NODE_ROWS, NODE_COLUMNS, MARKERS_BETWEEN_NODES)
