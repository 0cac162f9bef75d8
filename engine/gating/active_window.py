"""The window in use: as requested, per cent converted to mm or l, moved by confirmed baseline corrections.

It never moves by itself. The sum of all corrections is bounded, so that many small ones cannot exceed the site's limit.

How much of the learned breaths lies in a window: one that the signal practically never leaves gates nothing.

Predicted from the model's training frames, against the present reference, for the window in use: in mm or l, with its
baseline correction. Hysteresis is left out, and where levels and phases are joined, the largest possible share counts:
the prediction errs on the side of a refusal. A breath hold that is needed is not predicted, as free breathing does not
show how it is held; its own limits end it, and its level may not lie where the patient breathes freely. As one of
several ways into the beam it counts as an amplitude.

Another window for a session: other numbers in the same conditions.

What follows the breathing was prepared for the signals the session was created with, and a treatment plan was compared
with the kind of its window. Both stay: other signals and kinds of conditions need another session.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from engine.core.errors import CommandRefusedError, InvalidValueError
from engine.core.sentences import listed, say
from engine.core.signals import LearnedLevels, Ranges, ranges_of
from engine.gating.limits import GateLimits
from engine.gating.windows import (
    LEVEL_NOT_SET,
    AmplitudeWindow,
    BreathHoldWindow,
    Condition,
    GateWindow,
    HoldKind,
    Join,
    JoinedWindow,
    PhaseWindow,
    Unit,
)

PHASES = np.linspace(0.0, 100.0, 1_000, endpoint=False)
INSPIRATION_FROM, EXPIRATION_TO = 60.0, 40.0
"""Lowest lower edge of an inspiration hold, and highest upper edge of an expiration hold [% of the learned breath]."""
LAST_PERCENT = 100.0
UNKNOWN = say("How much of a breath lies in the window is not known for this model. Train again.")


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
    return listed(", ", map(_leaf_text, window.leaves))


def unresolved_text(window: GateWindow) -> str:
    """Return why a window that `needs_ranges` cannot gate."""
    if any(isinstance(leaf, BreathHoldWindow) and not leaf.is_level_set for leaf in window.leaves):
        return LEVEL_NOT_SET
    return say("The window is in per cent, but this model has no breathing range. Train again.")


def _edges_of(leaf: Condition) -> AmplitudeWindow | None:
    match leaf:
        case AmplitudeWindow():
            return leaf
        case BreathHoldWindow():
            return leaf.level
    return None


def _leaf_text(leaf: Condition) -> str:
    if isinstance(leaf, PhaseWindow):
        return say(
            "{label} {from_percent:g} to {to_percent:g} % of the breath",
            label=leaf.choice.label,
            from_percent=leaf.from_percent,
            to_percent=leaf.to_percent,
        )
    if isinstance(leaf, BreathHoldWindow) and not leaf.is_level_set:
        return say("{label}, level not set", label=leaf.level.choice.label)
    edges = leaf.level if isinstance(leaf, BreathHoldWindow) else leaf
    return say(
        "{label} {lower:.4g} to {upper:.4g} {unit}",
        label=edges.choice.label,
        lower=edges.lower,
        upper=edges.upper,
        unit=edges.unit,
    )


def is_predicted(window: GateWindow) -> bool:
    """Return whether a window has a predicted duty cycle: one that needs a breath hold has none."""
    return _is_any(window) or not any(isinstance(leaf, BreathHoldWindow) for leaf in window.leaves)


def duty_percent(window: GateWindow, levels: LearnedLevels) -> float | None:
    """Return the share of the learned breaths inside a window, 0 to 100.

    None where a signal's levels are not known, for edges in per cent, and without a prediction (see `is_predicted`).
    """
    if not is_predicted(window) or window.needs_ranges:
        return None
    edges = [leaf.level if isinstance(leaf, BreathHoldWindow) else leaf for leaf in window.leaves]
    amplitudes = [leaf for leaf in edges if isinstance(leaf, AmplitudeWindow)]
    if any(leaf.choice not in levels for leaf in amplitudes):
        return None
    by_level = [(leaf.lower <= levels[leaf.choice]) & (levels[leaf.choice] <= leaf.upper) for leaf in amplitudes]
    by_phase = [
        np.array([leaf.contains(phase) for phase in PHASES]) for leaf in window.leaves if isinstance(leaf, PhaseWindow)
    ]
    join = np.any if _is_any(window) else np.all
    shares = [float(join(inside, axis=0).mean()) for inside in (by_level, by_phase) if inside]
    return 100.0 * (min(1.0, sum(shares)) if _is_any(window) else min(shares))


def refuse_never_left(limits: GateLimits, levels: LearnedLevels) -> None:
    """Refuse a window that the learned breaths practically never leave.

    Raises
    ------
    InvalidValueError
        The predicted duty cycle is above the site's limit.
    CommandRefusedError
        It is not known.
    """
    window = limits.window
    if not is_predicted(window):
        return
    percent = duty_percent(window, levels)
    if percent is None:
        raise CommandRefusedError(UNKNOWN)
    if not percent <= limits.max_duty_percent:
        bound = (
            f"one that the patient leaves in every breath: {percent:.0f} % of the learned breaths lie inside, and at "
            f"most {limits.max_duty_percent:g} % may"
        )
        raise InvalidValueError("window", window_text(window), bound)


def refuse_hold_in_free_breath(limits: GateLimits, levels: LearnedLevels) -> None:
    """Refuse a breath hold whose level the patient reaches by breathing freely.

    An inspiration hold begins above `INSPIRATION_FROM` of the learned breath and reaches above its end of inhale; an
    expiration hold ends below `EXPIRATION_TO` of it.

    Raises
    ------
    InvalidValueError
        The hold's edges lie in the learned breath.
    CommandRefusedError
        The learned breath is not known.
    """
    ranges = ranges_of(levels)
    for leaf in limits.window.leaves:
        if not isinstance(leaf, BreathHoldWindow):
            continue
        learned = ranges.get(leaf.level.choice)
        if learned is None or not learned.high > learned.low or leaf.needs_ranges:
            raise CommandRefusedError(UNKNOWN)
        lower, upper = learned.percent(leaf.level.lower), learned.percent(leaf.level.upper)
        if leaf.kind is HoldKind.INSPIRATION:
            is_free = not (lower >= INSPIRATION_FROM and upper > LAST_PERCENT)
            bound = f"from at least {INSPIRATION_FROM:g} % to above 100 % of the learned breath (0 % end of exhale)"
        else:
            is_free = not upper <= EXPIRATION_TO
            bound = f"up to at most {EXPIRATION_TO:g} % of the learned breath (0 % end of exhale)"
        if is_free:
            bound = (
                f"for an {leaf.kind} hold {bound}: it is {lower:.0f} to {upper:.0f} %; hold a breath, and set it there"
            )
            raise InvalidValueError("window", window_text(leaf), bound)


def _is_any(window: GateWindow) -> bool:
    return isinstance(window, JoinedWindow) and window.join is Join.OR


@dataclass(frozen=True, slots=True, kw_only=True)
class SetWindow:
    """Gate by another window from now on; refused while the gate is armed.

    Attributes
    ----------
    window
        As prescribed, in mm, l or per cent; drops a baseline correction.
    dwell_ms, min_on_ms, min_off_ms, max_cycles_per_min
        As in :class:`engine.gating.limits.GateLimits`.
    reason
        Required beyond the budget from the fraction's first armed window.
    may_exceed
        Whether the operator is a person who may arm: with a reason, the budget may be exceeded.
    """

    operator: str
    window: GateWindow
    dwell_ms: float
    min_on_ms: float
    min_off_ms: float
    max_cycles_per_min: int
    reason: str = ""
    may_exceed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowChange:
    """A window that was checked, and the limits with it."""

    window: ActiveWindow
    limits: GateLimits


def checked_change(present: GateWindow, command: SetWindow, limits: GateLimits, ranges: Ranges) -> WindowChange:
    """Return the window and the limits after ``command``; per cent are converted where ``ranges`` are known.

    Parameters
    ----------
    present
        The window as prescribed until now.
    ranges
        Of the signals in the training, against the present reference; empty where there is none.

    Raises
    ------
    InvalidValueError
        Other conditions than the present window has, or a number beyond its bounds or the site's.
    """
    _refuse_other_conditions(present, command.window)
    window = ActiveWindow(requested=command.window, converted=command.window.resolved(ranges))
    refuse_wide(window.window, limits)
    return WindowChange(
        window=window,
        limits=replace(
            limits,
            window=window.window,
            dwell_ms=command.dwell_ms,
            min_on_ms=command.min_on_ms,
            min_off_ms=command.min_off_ms,
            max_cycles_per_min=command.max_cycles_per_min,
        ),
    )


def _refuse_other_conditions(present: GateWindow, wanted: GateWindow) -> None:
    """Refuse other kinds of conditions, other signals, another number, order or join."""
    if _shape(present) != _shape(wanted):
        bound = (
            f"in the session's own conditions ({window_text(present)}) with other numbers: "
            "other signals or kinds of conditions need another session"
        )
        raise InvalidValueError("window", window_text(wanted), bound)


def _shape(window: GateWindow) -> tuple[object, ...]:
    join = window.join if isinstance(window, JoinedWindow) else None
    kinds = [leaf.kind if isinstance(leaf, BreathHoldWindow) else None for leaf in window.leaves]
    return join, kinds, [(type(leaf), leaf.choices) for leaf in window.leaves]
