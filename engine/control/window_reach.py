"""How far a window reaches beyond another one, in mm of the patient: its edges, with the reference they count from."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from engine.core.breath import SignalChoice
from engine.core.reference_distance import ReferenceDistance
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, GateWindow, PhaseWindow, Unit


class _Edges(NamedTuple):
    """Edges of a condition against the fraction's first reference, in mm; of a phase in per cent of the breath."""

    lower: float
    upper: float
    is_phase: bool


PlacedWindow = tuple[_Edges, ...]
"""The edges of a window's conditions, in their order."""


def placed_window(window: GateWindow, reference: ReferenceDistance | None) -> PlacedWindow | None:
    """Return where a window's edges lie against the fraction's first reference; None while any is in per cent.

    Parameters
    ----------
    reference
        That of the window, without its correction; None for the first one itself. A level that is not known counts as
        that of the first: a reference at an unknown distance has a person's reason of its own.
    """
    levels = {} if reference is None else {one.choice: one.level for one in reference.levels}
    placed = [_placed(leaf, levels) for leaf in window.leaves]
    return None if None in placed else tuple(one for one in placed if one is not None)


def _placed(
    leaf: AmplitudeWindow | BreathHoldWindow | PhaseWindow, levels: Mapping[SignalChoice, float]
) -> _Edges | None:
    if isinstance(leaf, PhaseWindow):
        return _Edges(leaf.from_percent, leaf.to_percent, is_phase=True)
    edges = leaf.level if isinstance(leaf, BreathHoldWindow) else leaf
    if edges.unit is Unit.PERCENT:
        return None
    known, per_mm = levels.get(edges.choice, 0.0), edges.choice.per_mm
    level = known if math.isfinite(known) else 0.0
    return _Edges((edges.lower + level) / per_mm, (edges.upper + level) / per_mm, is_phase=False)


def reach_beyond_mm(before: PlacedWindow, now: PlacedWindow) -> float:
    """Return how far ``now`` reaches beyond ``before`` [mm], of both of the same conditions; 0 where it lies inside.

    Infinite for a phase that reaches beyond the earlier one.
    """
    return max(0.0, *(_beyond(*pair) for pair in zip(before, now, strict=True)))


def _beyond(before: _Edges, now: _Edges) -> float:
    if now.is_phase:
        width, offset = _arc(before.lower, before.upper), _arc(before.lower, now.lower)
        return 0.0 if offset + _arc(now.lower, now.upper) <= width else math.inf
    return max(before.lower - now.lower, now.upper - before.upper)


def _arc(start: float, end: float) -> float:
    """Return the way from one phase to another [%], onwards."""
    return (end - start) % 100.0
