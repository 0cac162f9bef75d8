"""How much of the learned breaths lies in a window: one that the signal practically never leaves gates nothing.

Predicted from the model's training frames, against the present reference, for the window in use: in mm or l, with its
baseline correction. Hysteresis is left out, and where levels and phases are joined, the largest possible share counts:
the prediction errs on the side of a refusal. A breath hold that is needed is not predicted, as free breathing does not
show how it is held; its own limits end it, and its level may not lie where the patient breathes freely. As one of
several ways into the beam it counts as an amplitude.
"""

import numpy as np

from engine.core.errors import CommandRefusedError, InvalidValueError
from engine.core.ranges import LearnedLevels, ranges_of
from engine.gating.active_window import window_text
from engine.gating.limits import GateLimits
from engine.gating.windows import (
    AmplitudeWindow,
    BreathHoldWindow,
    GateWindow,
    HoldKind,
    Join,
    JoinedWindow,
    PhaseWindow,
)

PHASES = np.linspace(0.0, 100.0, 1_000, endpoint=False)
INSPIRATION_FROM, EXPIRATION_TO = 60.0, 40.0
"""Lowest lower edge of an inspiration hold, and highest upper edge of an expiration hold [% of the learned breath]."""
LAST_PERCENT = 100.0
UNKNOWN = "How much of a breath lies in the window is not known for this model. Train again."


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
