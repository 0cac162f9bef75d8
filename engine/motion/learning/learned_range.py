"""Levels and breathing range during training, the range being the scale of windows in per cent.

Computed from the model alone, so that a stored model has the same range: the coefficients of its training frames give
the depth of every region, and the present reference converts it to motion. The 5th percentile, the end of exhale, is
0 %; the 95th is 100 %.
"""

from collections.abc import Iterable

import numpy as np

from engine.core.breath import GateSignal, SignalChoice
from engine.core.frames import NODE_COLUMNS, FloatArray
from engine.core.ranges import LearnedLevels, Ranges, ranges_of
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.stages.surface import vertices_mm

MIN_SEEN_SHARE = 0.5


def learned_levels(active: PreparedModel, reference: Reference, choices: Iterable[SignalChoice]) -> LearnedLevels:
    """Return each signal's levels in the training relative to the reference; signals without levels are left out."""
    scores = active.model.scores_mm
    if scores is None or len(scores) < 2:
        return {}
    coefficients = np.zeros((len(scores), len(active.node_modes)))
    coefficients[:, : scores.shape[1]] = scores
    found = {choice: _signal(choice, active, reference, coefficients) for choice in choices}
    return {choice: levels for choice, levels in found.items() if np.isfinite(levels).all()}


def learned_ranges(active: PreparedModel, reference: Reference, choices: Iterable[SignalChoice]) -> Ranges:
    """Return the range of each signal relative to the reference [mm or l]; signals without a range are left out."""
    return ranges_of(learned_levels(active, reference, choices))


def _signal(choice: SignalChoice, active: PreparedModel, reference: Reference, coefficients: FloatArray) -> FloatArray:
    if choice.is_volume:
        return _volumes_l(active, reference, coefficients)
    position = position_of(choice, active)
    if position is None or not active.regions.is_known[position]:
        return np.full(len(coefficients), np.nan)
    depth_mm = active.regions.mean_mm[position] + coefficients @ active.regions.modes[position]
    return np.asarray(reference.regions_mm[position] - depth_mm)


def _volumes_l(active: PreparedModel, reference: Reference, coefficients: FloatArray) -> FloatArray:
    rays = None if active.model.surface_mm is None else _rays(active.model.surface_mm)
    if rays is None:
        return np.full(len(coefficients), np.nan)
    return np.array([reference.volume_above_l(vertices_mm(rays, active.node_depth_mm(one))) for one in coefficients])


def _rays(surface_mm: FloatArray) -> FloatArray | None:
    """Return the depth camera's rays (x/z, y/z) at the nodes, shape (nodes, 2); missing ones are interpolated."""
    rows, columns = np.divmod(np.arange(len(surface_mm)), NODE_COLUMNS)
    is_seen = np.asarray(np.isfinite(surface_mm).all(axis=1))
    if is_seen.sum() < MIN_SEEN_SHARE * len(surface_mm):
        return None
    rays = surface_mm[:, :2] / surface_mm[:, 2:]
    place = np.column_stack([np.ones(len(rows)), rows, columns, rows * columns])
    plane, *_ = np.linalg.lstsq(place[is_seen], rays[is_seen], rcond=None)
    return np.where(is_seen[:, None], rays, place @ plane)


def position_of(choice: SignalChoice, active: PreparedModel) -> int | None:
    """Index of a signal among the regions' means; None if there is no such cell, point or region."""
    regions = active.regions
    match choice.signal:
        case GateSignal.REGION:
            row, column = choice.row or 0, choice.column or 0
            return row * regions.columns + column if row < regions.rows and column < regions.columns else None
        case GateSignal.POINT:
            return regions.points_from + choice.index if choice.index < len(regions.layout.points) else None
        case GateSignal.NAMED:
            return regions.named_from + choice.index if choice.index < len(regions.layout.named) else None
    return regions.cells + (GateSignal.WHOLE, GateSignal.THORAX, GateSignal.ABDOMEN).index(GateSignal(choice.signal))
