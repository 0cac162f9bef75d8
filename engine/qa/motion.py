"""Measured against commanded motion: lag, amplitude, offset and error, both from the same reference.

Longest beam-on time while the commanded position is outside of the window.

The sine method takes medians, so a single beam-on interval that ends late, or lies outside of the window, does not
change its figures. This figure is the worst case: it counts every beam-on time outside of the window, also in cycles
that are no sine or hold more than one interval.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from engine.core.frames import FloatArray
from engine.qa.trace import MIN_REACH_MM, CommandedTrace

MAX_LAG_S = 0.6
LAG_STEP_S = 0.01
MIN_FRAMES = 60
STILL_MM = 1e-3
STEP_S = 0.001


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionAgreement:
    """Agreement of measured and commanded motion.

    Attributes
    ----------
    lag_s
        Lag of the measured motion [s], positive when it is later.
    ratio
        Measured amplitude over commanded amplitude.
    offset_mm
        Mean of measured less commanded motion, the lag removed [mm].
    mean_error_mm, p95_error_mm
        Mean and 95th percentile of the absolute difference, the lag removed [mm].
    frames
        Number of frames compared.
    """

    lag_s: float
    ratio: float
    offset_mm: float
    mean_error_mm: float
    p95_error_mm: float
    frames: int


def compare_motion(
    time_s: FloatArray, measured_mm: FloatArray, trace: CommandedTrace, reference_s: float, exhales: int = 0
) -> MotionAgreement | str:
    """Estimate the lag and compare the motions with it removed.

    Parameters
    ----------
    time_s
        Time of each frame on the trace's clock [s], shape (n,).
    measured_mm
        Motion from the reference [mm], shape (n,), finite.
    reference_s
        Time at which the reference was set [s].
    exhales
        How many of the last ends of exhale the reference is the mean of; 0 where it is the position at that time.

    Returns
    -------
    MotionAgreement | str
        The reason, a sentence, where the motions cannot be compared.
    """
    first, last = trace.span_s
    is_commanded = (time_s > first + MAX_LAG_S) & (time_s < last - MAX_LAG_S)
    count = int(is_commanded.sum())
    if count < MIN_FRAMES:
        return f"{count} measured frames are within the commanded trace: at least {MIN_FRAMES} are needed"
    if not first + MAX_LAG_S < reference_s < last - MAX_LAG_S:
        return f"the reference was set at {reference_s:.1f} s, outside of the commanded trace"
    at_s, motion_mm = time_s[is_commanded], measured_mm[is_commanded]
    if np.ptp(trace.at(at_s)) < MIN_REACH_MM:
        return f"the commanded trace moves by less than {MIN_REACH_MM:g} mm while it is measured"
    if np.ptp(motion_mm) < STILL_MM:
        return "the measured motion is constant"
    lag_s = _lag_s(at_s, motion_mm, trace)
    zero_mm = commanded_zero_mm(trace, reference_s - lag_s, exhales)
    trouble = _fit_trouble(lag_s, zero_mm, exhales)
    if trouble:
        return trouble
    commanded_mm = trace.at(at_s - lag_s) - zero_mm
    error_mm = motion_mm - commanded_mm
    return MotionAgreement(
        lag_s=lag_s,
        ratio=float(np.polyfit(commanded_mm, motion_mm, 1)[0]),
        offset_mm=float(error_mm.mean()),
        mean_error_mm=float(np.abs(error_mm).mean()),
        p95_error_mm=float(np.percentile(np.abs(error_mm), 95.0)),
        frames=count,
    )


def _fit_trouble(lag_s: float, zero_mm: float, exhales: int) -> str:
    """Return why lag or reference do not fit the trace; empty if both do."""
    if abs(lag_s) > MAX_LAG_S - LAG_STEP_S:
        return f"no lag within {1000 * MAX_LAG_S:.0f} ms fits: is the trace's time 0 known?"
    if not math.isfinite(zero_mm):
        return f"the commanded trace has fewer than {exhales} ends of exhale before the reference"
    return ""


def commanded_zero_mm(trace: CommandedTrace, reference_s: float, exhales: int) -> float:
    """Return the commanded position of a reference [mm], as in `compare_motion`; NaN where it is not known."""
    if exhales > 0:
        return trace.ends_of_exhale_mm(reference_s, exhales)
    return float(trace.at(np.array([reference_s]))[0])


def _lag_s(at_s: FloatArray, motion_mm: FloatArray, trace: CommandedTrace) -> float:
    """Find the lag of the highest correlation, which does not depend on scale and offset [s]."""

    def dissimilarity(lag_s: float) -> float:
        commanded = trace.at(at_s - lag_s)
        if np.ptp(commanded) < STILL_MM:
            return 1.0
        return -float(np.corrcoef(commanded, motion_mm)[0, 1])

    coarse = np.arange(-MAX_LAG_S, MAX_LAG_S + 0.5 * LAG_STEP_S, LAG_STEP_S)
    best = float(coarse[int(np.argmin([dissimilarity(lag_s) for lag_s in coarse.tolist()]))])
    span = (max(best - LAG_STEP_S, -MAX_LAG_S), min(best + LAG_STEP_S, MAX_LAG_S))
    return float(minimize_scalar(dissimilarity, bounds=span, method="bounded").x)


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
