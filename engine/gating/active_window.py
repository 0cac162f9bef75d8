"""The window in use: as requested, per cent converted to mm or l, moved by confirmed baseline corrections.

It never moves by itself. The sum of all corrections is bounded, so that many small ones cannot exceed the site's limit.
"""

import math
from dataclasses import dataclass, replace

from engine.core.errors import InvalidValueError
from engine.core.ranges import Ranges
from engine.gating.limits import GateLimits
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, Condition, GateWindow, PhaseWindow, Unit


@dataclass(frozen=True, slots=True, kw_only=True)
class ActiveWindow:
    """A window as requested, as converted, and its correction.

    Attributes
    ----------
    correction
        How far the edges on the first signal were moved [mm, l of the volume].
    """

    requested: GateWindow
    converted: GateWindow
    correction: float = 0.0

    @property
    def window(self) -> GateWindow:
        """The window in use."""
        return (
            self.converted
            if self.correction == 0.0
            else self.converted.shifted(self.requested.choices[0], self.correction)
        )

    def with_ranges(self, ranges: Ranges) -> "ActiveWindow":
        """Convert again, for a new reference; the correction is dropped."""
        return ActiveWindow(requested=self.requested, converted=self.requested.resolved(ranges))

    def without_correction(self) -> "ActiveWindow":
        """Drop the correction: motion is measured against a new reference."""
        return replace(self, correction=0.0)

    def corrected(self, by: float, limits: GateLimits) -> "ActiveWindow":
        """Move the edges on the first signal by ``by``, on top of earlier corrections.

        Raises
        ------
        InvalidValueError
            Not finite, in sum beyond the site's limit, without an edge to move, or still in per cent.
        """
        choice = self.requested.choices[0]
        unit, reach = choice.unit, limits.max_baseline_correction_mm * choice.per_mm
        low, high = -reach - self.correction, reach - self.correction
        if isinstance(by, bool) or not isinstance(by, int | float) or not math.isfinite(by) or not low <= by <= high:
            before = f", {self.correction:g} {unit} of {reach:g} already used" if self.correction else ""
            raise InvalidValueError("by", by, f"a number from {low:g} to {high:g} {unit}{before}")
        if all(isinstance(leaf, PhaseWindow) for leaf in self.requested.leaves if choice in leaf.choices):
            raise InvalidValueError("by", by, f"absent: the window has no edges on {choice.label} to move")
        moved = replace(self, correction=self.correction + float(by))
        _ = moved.window  # raises for a window still in per cent
        return moved


def refuse_wide(window: GateWindow, limits: GateLimits) -> None:
    """Raise InvalidValueError for an edge in mm beyond the site's limits."""
    for edge in map(_edges_of, window.leaves):
        if edge is None or edge.unit is not Unit.MM:
            continue
        if not edge.lower >= limits.window_lower_mm:
            raise InvalidValueError(
                "window.lower_mm", edge.lower, f"at least {limits.window_lower_mm:g}, the site's limit"
            )
        if not edge.upper <= limits.window_upper_mm:
            raise InvalidValueError(
                "window.upper_mm", edge.upper, f"at most {limits.window_upper_mm:g}, the site's limit"
            )


def window_text(window: GateWindow) -> str:
    """Return a window's edges as text, for the audit."""
    return ", ".join(_leaf_text(leaf) for leaf in window.leaves)


def _edges_of(leaf: Condition) -> AmplitudeWindow | None:
    match leaf:
        case AmplitudeWindow():
            return leaf
        case BreathHoldWindow():
            return leaf.level
    return None


def _leaf_text(leaf: Condition) -> str:
    if isinstance(leaf, PhaseWindow):
        return f"{leaf.choice.label} {leaf.from_percent:g} to {leaf.to_percent:g} % of the breath"
    edges = leaf.level if isinstance(leaf, BreathHoldWindow) else leaf
    return f"{edges.choice.label} {edges.lower:.4g} to {edges.upper:.4g} {edges.unit}"
