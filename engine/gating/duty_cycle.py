"""How much of the learned breaths lies in a window: one that the signal practically never leaves gates nothing.

Predicted from the model's training frames, against the present reference, for the window in use: in mm or l, with its
baseline correction. Hysteresis is left out, and where levels and phases are joined, the largest possible share counts:
the prediction errs on the side of a refusal. A breath hold is not predicted, as free breathing does not show how it is
held; its own limits end it.
"""

import numpy as np

from engine.core.errors import CommandRefusedError, InvalidValueError
from engine.core.ranges import LearnedLevels
from engine.gating.active_window import window_text
from engine.gating.limits import GateLimits
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, GateWindow, Join, JoinedWindow, PhaseWindow

PHASES = np.linspace(0.0, 100.0, 1_000, endpoint=False)
UNKNOWN = "How much of a breath lies in the window is not known for this model. Train again."


def is_predicted(window: GateWindow) -> bool:
    """Return whether a window has a predicted duty cycle: one that needs a breath hold has none."""
    holds = [isinstance(leaf, BreathHoldWindow) for leaf in window.leaves]
    return not (all(holds) if _is_any(window) else any(holds))


def duty_percent(window: GateWindow, levels: LearnedLevels) -> float | None:
    """Return the share of the learned breaths inside a window, 0 to 100.

    None where a signal's levels are not known, for edges in per cent, and without a prediction (see `is_predicted`).
    """
    if not is_predicted(window) or window.needs_ranges:
        return None
    amplitudes = [leaf for leaf in window.leaves if isinstance(leaf, AmplitudeWindow)]
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


def _is_any(window: GateWindow) -> bool:
    return isinstance(window, JoinedWindow) and window.join is Join.OR
