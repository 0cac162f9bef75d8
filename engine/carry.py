"""Carry the zero of motion from one model to the next, so that a swap moves neither a region nor the volume.

A reference is a set of depths as one model sees them. Another model sees the same surface a little higher here and a
little lower there: its mean was learned from other noise, its shapes are other shapes. So the same frames are explained
with both, and the reference is moved by the difference of what they say, averaged. It is the difference of two biases:
over many retrainings it sums up to the last bias minus the first, and does not walk. A patient who drifts is seen to
drift by both models, so the zero does not follow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from engine.active_model import ActiveModel, Reference
from engine.errors import TrainingRefusedError
from engine.frames import FloatArray, Projection, RoiDepth, frozen
from engine.gathering import GatheredFrame, Vertices, evenly
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS
from engine.stages.surface import grid_triangles, volume_l

CARRY_FRAMES = 40
CARRY_SECONDS = 8.0
MIN_CARRY_FRAMES = 10
CELLS_PERCENTILE = 90.0

Explain = Callable[[ActiveModel, RoiDepth, FloatArray | None], Projection | None]
"""Explain a region with a model, starting from coefficients; None where the model does not explain it well enough."""

_TRIANGLES = grid_triangles(NODE_ROWS, NODE_COLUMNS)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Carry:
    """How a new model sees the same frames against the one before it.

    Attributes
    ----------
    regions_mm
        New depth minus old of every region, in the order of :class:`engine.stages.regions.RegionMeans` [mm].
    volume_l
        New volume minus old above the same plane [l].
    frames
        How many frames both explained.
    correction_mm
        Largest of whole, thorax and abdomen, and of nine tenths of the cells that both know [mm].
    whole_mm
        Of the whole region [mm].
    """

    regions_mm: FloatArray
    volume_l: float
    frames: int
    correction_mm: float
    whole_mm: float

    def __post_init__(self) -> None:
        """Make the array read-only."""
        frozen(self.regions_mm)

    def applied(self, reference: Reference) -> Reference:
        """Return the reference as the new model sees it."""
        return replace(
            reference,
            regions_mm=frozen(reference.regions_mm + self.regions_mm),
            volume_l=reference.volume_l + self.volume_l,
        )


def recent(frames: Sequence[GatheredFrame]) -> list[GatheredFrame]:
    """Choose the frames to compare two models on: evenly over the last eight seconds, about two breaths."""
    since_us = frames[-1].timestamp_us - CARRY_SECONDS * 1e6
    return evenly([frame for frame in frames if frame.timestamp_us >= since_us], CARRY_FRAMES)


def compare_models(
    before: ActiveModel,
    after: ActiveModel,
    frames: Sequence[GatheredFrame],
    *,
    explain: Explain,
    vertices: Vertices,
) -> Carry:
    """Explain the same frames with both models.

    Raises
    ------
    TrainingRefusedError
        Too few frames are explained by both: the zero cannot be carried over.
    """
    regions, volumes = [], []
    coefficients: dict[int, FloatArray | None] = {0: None, 1: None}
    for frame in frames:
        outcomes = []
        for i, model in enumerate((before, after)):
            outcome = explain(model, frame.roi, coefficients[i])
            coefficients[i] = None if outcome is None else outcome.coefficients
            outcomes.append(None if outcome is None else _seen(model, outcome, frame, vertices))
        old, new = outcomes
        if old is not None and new is not None:
            regions.append(new[0] - old[0])
            volumes.append(new[1] - old[1])
    if len(regions) < MIN_CARRY_FRAMES:
        raise TrainingRefusedError(
            "carry.frames",
            len(regions),
            f"at least {MIN_CARRY_FRAMES} frames that both models explain",
            "the patient does not lie as the present model knows: learn again without keeping the zero, then set it",
        )
    difference = np.mean(regions, axis=0)
    return Carry(
        regions_mm=difference,
        volume_l=float(np.mean(volumes)),
        frames=len(regions),
        correction_mm=_correction_mm(before, after, difference),
        whole_mm=float(difference[before.regions.cells]),
    )


def _seen(
    model: ActiveModel, outcome: Projection, frame: GatheredFrame, vertices: Vertices
) -> tuple[FloatArray, float]:
    surface = vertices(frame.nodes_px, model.node_depth_mm(outcome.coefficients))
    # Any plane will do for a difference of two nearly equal surfaces; at zero, their whole volume is under it.
    return model.regions.model_depth_mm(outcome.coefficients), volume_l(surface, _TRIANGLES, _plane_mm(frame))


def _plane_mm(frame: GatheredFrame) -> float:
    """Return a plane close to the surface that is the same for both models: the median depth seen."""
    depth, valid = frame.roi.depth_mm, frame.roi.valid
    return float(np.median(depth[valid])) if valid.any() else 0.0


def _correction_mm(before: ActiveModel, after: ActiveModel, difference: FloatArray) -> float:
    cells, points_from = before.regions.cells, before.regions.points_from
    wide = np.abs(difference[cells:points_from]).max()
    both = before.regions.is_known[:cells] & after.regions.is_known[:cells]
    known = np.abs(difference[:cells][both])
    return float(max(wide, np.percentile(known, CELLS_PERCENTILE) if known.size else 0.0))
