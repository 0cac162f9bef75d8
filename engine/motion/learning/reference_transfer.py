"""Transfers the reference from one model to the next, so that a switch changes neither motion nor volume.

A reference is a set of depths as one model measures them. Another model measures the same surface with other biases:
its mean was learned with other noise, and its components differ. The same frames are therefore projected on both
models, and the reference is corrected by the mean difference. That is a difference of two biases: over many retrainings
the corrections sum up to the last bias minus the first, without a random walk. A drift of the patient appears in both
models, so the reference does not follow it.

Smooths a new reference over the last half second.

The noise of a single reference frame would enter every motion measured from it. The last frames are therefore projected
again, and a parabola fitted to each coefficient gives its value at the newest frame: half the noise, without lag.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from engine.core.errors import TrainingRefusedError
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, BoolArray, FloatArray, Projection, RoiDepth, frozen
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.training_set import TrainingFrame, Vertices, evenly
from engine.motion.stages.projection import project
from engine.motion.stages.surface import grid_triangles, volume_l

TRANSFER_FRAMES = 40
TRANSFER_SECONDS = 8.0
MIN_TRANSFER_FRAMES = 10
CELLS_PERCENTILE = 90.0

Explain = Callable[[PreparedModel, RoiDepth, FloatArray | None], Projection | None]
"""Projects a region on a model, starting from coefficients; None if the model does not explain it well enough."""

_TRIANGLES = grid_triangles(NODE_ROWS, NODE_COLUMNS)
FRAMES = 15
WINDOW_US = 500_000  # over a longer time a breath is not a parabola
MIN_FRAMES = 7
MAX_GAP_US = 100_000
DEGREE = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferenceTransfer:
    """Difference of a new model and the previous one on the same frames.

    Attributes
    ----------
    regions_mm
        New depth minus old of every region [mm], in the order of `engine.motion.stages.regions.RegionMeans`.
    volume_l
        New volume minus old above the same plane [l].
    frames
        Number of frames that both models explain.
    correction_mm
        Largest absolute correction of whole, thorax and abdomen, and 90th percentile of the common cells [mm].
    whole_mm
        Correction of the whole region [mm].
    seen_shares
        How much of every region was seen on those frames, 0 to 1, in the same order.
    """

    regions_mm: FloatArray
    volume_l: float
    frames: int
    correction_mm: float
    whole_mm: float
    seen_shares: FloatArray

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        frozen(self.regions_mm)
        frozen(self.seen_shares)

    def applied(self, reference: Reference) -> Reference:
        """Return the reference corrected for the new model; a region unseen meanwhile is unseen in it."""
        return replace(
            reference,
            regions_mm=frozen(reference.regions_mm + self.regions_mm),
            volume_l=reference.volume_l + self.volume_l,
            seen_shares=frozen(np.minimum(reference.seen_shares, self.seen_shares)),
            surface_mm=self.applied_to_surface(reference.surface_mm),
        )

    def applied_to_surface(self, surface_mm: FloatArray) -> FloatArray:
        """Return points [mm], shape (n, 3), moved along their rays by the correction of the whole region."""
        return frozen(surface_mm * (1.0 + self.whole_mm / surface_mm[:, 2:]))


def recent(frames: Sequence[TrainingFrame]) -> list[TrainingFrame]:
    """Select the frames to compare two models on: evenly over the last eight seconds, about two breaths."""
    since_us = frames[-1].timestamp_us - TRANSFER_SECONDS * 1e6
    return evenly([frame for frame in frames if frame.timestamp_us >= since_us], TRANSFER_FRAMES)


def compare_models(
    before: PreparedModel,
    after: PreparedModel,
    frames: Sequence[TrainingFrame],
    *,
    explain: Explain,
    vertices: Vertices,
) -> ReferenceTransfer:
    """Project the same frames on both models and return their difference.

    Raises
    ------
    TrainingRefusedError
        Too few frames are explained by both models, so the reference cannot be transferred.
    """
    regions, volumes, seen = [], [], []
    coefficients: dict[int, FloatArray | None] = {0: None, 1: None}
    for frame in frames:
        outcomes = []
        for i, model in enumerate((before, after)):
            outcome = explain(model, frame.roi, coefficients[i])
            coefficients[i] = None if outcome is None else outcome.coefficients
            outcomes.append(None if outcome is None else _measured_by(model, outcome, frame, vertices))
        old, new = outcomes
        if old is not None and new is not None:
            regions.append(new[0] - old[0])
            volumes.append(new[1] - old[1])
            seen.append(old[2] & new[2])
    if len(regions) < MIN_TRANSFER_FRAMES:
        raise TrainingRefusedError(
            "carry.frames",
            len(regions),
            f"at least {MIN_TRANSFER_FRAMES} frames that both models explain",
            "the patient's position does not match the present model: train again without keeping the reference, then "
            "set it",
        )
    difference = np.mean(regions, axis=0)
    return ReferenceTransfer(
        regions_mm=difference,
        volume_l=float(np.mean(volumes)),
        frames=len(regions),
        correction_mm=_correction_mm(before, after, difference),
        whole_mm=float(difference[before.regions.cells]),
        seen_shares=after.seen_weights.shares(np.mean(seen, axis=0)),
    )


def _measured_by(
    model: PreparedModel, outcome: Projection, frame: TrainingFrame, vertices: Vertices
) -> tuple[FloatArray, float, BoolArray]:
    surface = vertices(frame.nodes_px, model.node_depth_mm(outcome.coefficients))
    # The plane cancels in the difference of two nearly equal surfaces.
    volume = volume_l(surface, _TRIANGLES, _plane_mm(frame))
    return model.regions.model_depth_mm(outcome.coefficients), volume, outcome.is_seen


def _plane_mm(frame: TrainingFrame) -> float:
    """Return a plane close to the surface, the same for both models: the median depth [mm]."""
    depth, valid = frame.roi.depth_mm, frame.roi.valid
    return float(np.median(depth[valid])) if valid.any() else 0.0


def _correction_mm(before: PreparedModel, after: PreparedModel, difference: FloatArray) -> float:
    cells, points_from = before.regions.cells, before.regions.ends[1]
    wide = np.abs(difference[cells:points_from]).max()
    both = before.regions.is_known[:cells] & after.regions.is_known[:cells]
    known = np.abs(difference[:cells][both])
    return float(max(wide, np.percentile(known, CELLS_PERCENTILE) if known.size else 0.0))


class Smoothed(NamedTuple):
    """Coefficients, shape (k + e,), and the share of the frames in which each sampled point was seen, (88, 50)."""

    coefficients: FloatArray
    seen: FloatArray | BoolArray


class RecentFrames:
    """Buffer of the region's last consecutive frames."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, RoiDepth]] = deque(maxlen=FRAMES)

    def add(self, roi: RoiDepth, timestamp_us: int) -> None:
        """Add a frame, sampled at `STRIDE_PX`; a gap clears the frames before it."""
        if self._frames and not 0 < timestamp_us - self._frames[-1][0] <= MAX_GAP_US:
            self.reset()
        self._frames.append((timestamp_us, roi))

    def reset(self) -> None:
        """Clear the buffer."""
        self._frames.clear()

    def smoothed(self, active: PreparedModel, newest: Projection) -> Smoothed:
        """Return the smoothed coefficients of the newest frame; its own if there are too few frames."""
        since_us = self._frames[-1][0] - WINDOW_US if self._frames else 0
        recent = [(stamp, roi) for stamp, roi in self._frames if stamp >= since_us]
        explained = [(stamp, project(active.basis, roi, newest.coefficients)) for stamp, roi in recent]
        usable = [(stamp, found) for stamp, found in explained if found is not None]
        if len(usable) < MIN_FRAMES:
            return Smoothed(coefficients=newest.coefficients, seen=newest.is_seen)
        seconds = np.array([stamp - usable[-1][0] for stamp, _ in usable]) / 1e6
        coefficients = np.array([found.coefficients for _, found in usable])
        parabola = np.polynomial.polynomial.polyfit(seconds, coefficients, DEGREE)
        seen = np.mean([found.is_seen for _, found in usable], axis=0)
        return Smoothed(coefficients=np.asarray(parabola[0]), seen=seen)
