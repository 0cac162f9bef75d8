"""Measures frames from before the model, once there is one, as live frames are; runs in the trainer's thread."""

from functools import lru_cache

from engine.core.breath import SignalChoice
from engine.core.frames import FloatArray, Motion, PhaseLag, Projection, SeenShares, frozen
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.reference_proposals import PastMotion
from engine.motion.learning.reference_transfer import Explain
from engine.motion.learning.seen_shares import SeenWeights
from engine.motion.learning.training_set import TrainingFrame, Vertices
from engine.motion.tracking.breath_tracker import BreathTracker


def motion_from(
    reference: Reference,
    active: PreparedModel,
    outcome: Projection,
    surface: FloatArray,
    depth_mm: FloatArray,
    lags: tuple[PhaseLag, ...] = (),
) -> Motion:
    """Return the motion of a projected frame from a reference.

    Parameters
    ----------
    surface
        Its vertices [mm], shape (nodes, 3).
    depth_mm
        Its mean depth of every region [mm], by the regions of ``active``.
    """
    motion_mm = reference.regions_mm - depth_mm
    regions = active.regions
    cells, shape = regions.cells, (regions.rows, regions.columns)
    whole, thorax, abdomen = motion_mm[cells : regions.points_from].tolist()
    weights = active.seen_weights
    return Motion(
        whole_mm=whole,
        thorax_mm=thorax,
        abdomen_mm=abdomen,
        volume_l=reference.volume_above_l(surface),
        regions_mm=motion_mm[:cells].reshape(shape),
        regions_depth_mm=depth_mm[:cells].reshape(shape),
        points_mm=motion_mm[regions.points_from : regions.named_from],
        named_mm=motion_mm[regions.named_from :],
        projection=outcome,
        lags=lags,
        surface_mm=frozen(surface),
        split_rows=regions.layout.split,
        seen=weights.by_region(weights.shares(outcome.is_seen)),
        reference_seen=_reference_seen(reference, weights),
    )


@lru_cache(maxsize=4)
def _reference_seen(reference: Reference, weights: SeenWeights) -> SeenShares:
    """Return what was seen at a reference; it stands for many frames. Both are compared by identity."""
    return weights.by_region(reference.seen_shares)


class PastMeasurement:
    """Measures frames in order of time, with the breath of the first signal; motion is from the first frame."""

    def __init__(
        self, active: PreparedModel, signals: tuple[SignalChoice, ...], explain: Explain, vertices: Vertices
    ) -> None:
        self._active, self._explain, self._vertices = active, explain, vertices
        self._breaths = BreathTracker(signals[:1])
        self._coefficients: FloatArray | None = None
        self._reference: Reference | None = None

    def __call__(self, frame: TrainingFrame) -> PastMotion | None:
        """Return what is followed of a frame; None where the model does not explain it, and without a signal."""
        active = self._active
        outcome = self._explain(active, frame.roi, self._coefficients)
        self._coefficients = None if outcome is None else outcome.coefficients
        if outcome is None:
            return None
        surface = self._vertices(frame.nodes_px, active.node_depth_mm(outcome.coefficients))
        if self._reference is None:
            shares = active.seen_weights.shares(outcome.is_seen)
            self._reference = active.reference(outcome.coefficients, surface, shares)
        depth_mm = active.regions.depth_mm(outcome.coefficients)
        motion = motion_from(self._reference, active, outcome, surface, depth_mm)
        breaths = self._breaths.follow(motion, frame.timestamp_us)
        return PastMotion(outcome.coefficients, motion, breaths[0], self._reference) if breaths else None
