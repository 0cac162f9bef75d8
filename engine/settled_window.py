"""The window the gate decides by: as it was told, with per cent turned into mm or l, and moved as a person confirmed.

Nothing moves it by itself. Corrections add up, and their sum is bounded, so that many small ones never come to more
than the site allows.
"""

import math
from dataclasses import dataclass, replace

from engine.errors import InvalidValueError
from engine.limits import GateLimits
from engine.windows import AmplitudeWindow, BreathHoldWindow, Condition, GateWindow, PhaseWindow, Ranges, Unit

LITRES_PER_MM = 0.1
"""What a region of 350 mm by 300 mm holds more when it rises by a millimetre [l/mm]: bounds a correction in l."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SettledWindow:
    """A window on its way from what was told to what is decided by.

    Attributes
    ----------
    correction
        How far the edges on the first signal were moved [mm, l of the volume].
    """

    told: GateWindow
    settled: GateWindow
    correction: float = 0.0

    @property
    def window(self) -> GateWindow:
        """What the gate decides by."""
        return self.settled if self.correction == 0.0 else self.settled.shifted(self.told.choices[0], self.correction)

    def with_ranges(self, ranges: Ranges) -> "SettledWindow":
        """Settle anew, for another zero; a correction of the one before goes with it."""
        return SettledWindow(told=self.told, settled=self.told.resolved(ranges))

    def without_correction(self) -> "SettledWindow":
        """Return to what was told: motion is counted from a new zero."""
        return replace(self, correction=0.0)

    def corrected(self, by: float, limits: GateLimits) -> "SettledWindow":
        """Move the edges on the first signal by ``by``, on top of earlier corrections.

        Raises
        ------
        InvalidValueError
            Not finite, in all further than the site allows, without an edge to move, or still in per cent.
        """
        choice = self.told.choices[0]
        unit = "l" if choice.is_volume else "mm"
        reach = limits.max_baseline_correction_mm * (LITRES_PER_MM if choice.is_volume else 1.0)
        low, high = -reach - self.correction, reach - self.correction
        if isinstance(by, bool) or not isinstance(by, int | float) or not math.isfinite(by) or not low <= by <= high:
            before = f", {self.correction:g} {unit} of {reach:g} being used up" if self.correction else ""
            raise InvalidValueError("by", by, f"a number from {low:g} to {high:g} {unit}{before}")
        if all(isinstance(leaf, PhaseWindow) for leaf in self.told.leaves if choice in leaf.choices):
            raise InvalidValueError("by", by, f"absent: the window has no edges on {choice.label} that it could move")
        moved = replace(self, correction=self.correction + float(by))
        _ = moved.window  # refuses what is still told in per cent
        return moved


def refuse_wide(window: GateWindow, limits: GateLimits) -> None:
    """Raise InvalidValueError where an edge in mm lies beyond the site's."""
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
    """Name a window's edges in a few words, for the audit."""
    return ", ".join(_leaf_text(leaf) for leaf in window.leaves)


def _edges_of(leaf: Condition) -> AmplitudeWindow | None:
    match leaf:
        case AmplitudeWindow():
            return leaf
        case BreathHoldWindow():
            return leaf.level
    return None


def _leaf_text(leaf: Condition) -> str:
    edges = _edges_of(leaf)
    if isinstance(leaf, PhaseWindow):
        return f"{leaf.choice.label} {leaf.from_percent:g} to {leaf.to_percent:g} % of the breath"
    if edges is None:
        return str(leaf)
    return f"{edges.choice.label} {edges.lower:.4g} to {edges.upper:.4g} {edges.unit}"
