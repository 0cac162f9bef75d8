"""Longest beam-on time while the commanded position is outside of the window.

The sine method takes medians, so a single beam-on interval that ends late, or lies outside of the window, does not
change its figures. This figure is the worst case: it counts every beam-on time outside of the window, also in cycles
that are no sine or hold more than one interval.
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
    """Sum the beam-on time of each excursion from the window and return the longest [s]; None outside of the trace.

    Parameters
    ----------
    intervals_s
        When the beam was on, as pairs (on, off) [s] on the trace's clock; the dwell is not subtracted.
    from_s, to_s
        The evaluated span of time [s].
    """
    first_s, last_s = trace.span_s
    start_s, end_s = max(from_s, first_s), min(to_s, last_s)
    if end_s - start_s < STEP_S:
        return None
    times = np.arange(start_s, end_s, STEP_S)
    position = trace.at(times)
    lower, upper = window_mm
    is_inside = (position >= lower) & (position <= upper)
    is_on = np.zeros(len(times), dtype=np.bool_)
    for on_s, off_s in intervals_s:
        is_on[np.searchsorted(times, on_s) : np.searchsorted(times, off_s)] = True
    excursion = np.cumsum(is_inside)  # stands still while the phantom is outside
    return STEP_S * float(np.bincount(excursion, weights=is_on & ~is_inside).max())
