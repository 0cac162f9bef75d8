"""How long the beam is on while the phantom was told to be outside of the window.

The sine method takes medians: one beam that goes off late, or on where it should not, moves none of its figures. This
one is the worst there was, and whatever is on outside counts, whether or not its cycle is a sine or holds one interval.
"""

from collections.abc import Iterable

import numpy as np

from engine.qa.trace import CommandedTrace

STEP_S = 0.001


def longest_outside_s(
    trace: CommandedTrace,
    window_mm: tuple[float, float],
    intervals_s: Iterable[tuple[float, float]],
    from_s: float,
    to_s: float,
) -> float | None:
    """Add up the beam's time in each excursion from the window, and return the longest; None outside of the trace.

    Parameters
    ----------
    intervals_s
        When the beam was on, dwell and all left as it was: that it waited does not excuse it.
    from_s, to_s
        What is looked at.
    """
    first_s, last_s = trace.span_s
    begins_s, ends_s = max(from_s, first_s), min(to_s, last_s)
    if ends_s - begins_s < STEP_S:
        return None
    times = np.arange(begins_s, ends_s, STEP_S)
    position = trace.at(times)
    lower, upper = window_mm
    is_inside = (position >= lower) & (position <= upper)
    is_on = np.zeros(len(times), dtype=np.bool_)
    for on_s, off_s in intervals_s:
        is_on[np.searchsorted(times, on_s) : np.searchsorted(times, off_s)] = True
    excursion = np.cumsum(is_inside)  # stands still while the phantom is outside
    return STEP_S * float(np.bincount(excursion, weights=is_on & ~is_inside).max())
