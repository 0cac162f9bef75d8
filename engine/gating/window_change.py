"""Another window for a session: other numbers in the same conditions.

What follows the breathing was prepared for the signals the session was created with, and a treatment plan was compared
with the kind of its window. Both stay: other signals and kinds of conditions need another session.
"""

from dataclasses import dataclass, replace

from engine.core.errors import InvalidValueError
from engine.core.ranges import Ranges
from engine.gating.active_window import ActiveWindow, refuse_wide, window_text
from engine.gating.limits import GateLimits
from engine.gating.windows import BreathHoldWindow, GateWindow, JoinedWindow


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
