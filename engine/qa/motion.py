"""Measured against commanded motion: lag, amplitude, offset and error, both from the same zero."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from engine.frames import FloatArray
from engine.qa.trace import LEAST_REACH_MM, CommandedTrace

LONGEST_LAG_S = 0.6
LAG_STEP_S = 0.01
FEWEST = 60
STILL_MM = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionAgreement:
    """How measured and commanded motion agree.

    Attributes
    ----------
    lag_s
        How much later the measured motion is.
    ratio
        Measured amplitude to commanded.
    offset_mm, mean_error_mm, p95_error_mm
        Of measured less commanded motion, the lag undone: mean, mean and 95th percentile of its size.
    """

    lag_s: float
    ratio: float
    offset_mm: float
    mean_error_mm: float
    p95_error_mm: float
    frames: int


def compare_motion(
    time_s: FloatArray, measured_mm: FloatArray, trace: CommandedTrace, zero_s: float
) -> MotionAgreement | str:
    """Compare, or say why they cannot be.

    Parameters
    ----------
    time_s
        When each frame was taken, on the trace's clock, shape (n,).
    measured_mm
        Motion from the zero, shape (n,), finite.
    zero_s
        When the zero was taken.
    """
    first, last = trace.span_s
    is_told = (time_s > first + LONGEST_LAG_S) & (time_s < last - LONGEST_LAG_S)
    if is_told.sum() < FEWEST:
        return f"{int(is_told.sum())} measured frames lie within the commanded trace: at least {FEWEST} are needed"
    if not first + LONGEST_LAG_S < zero_s < last - LONGEST_LAG_S:
        return f"the zero was taken at {zero_s:.1f} s, outside of the commanded trace"
    at_s, motion_mm = time_s[is_told], measured_mm[is_told]
    if np.ptp(trace.at(at_s)) < LEAST_REACH_MM:
        return f"the commanded trace moves by less than {LEAST_REACH_MM:g} mm while it is measured"
    if np.ptp(motion_mm) < STILL_MM:
        return "the measured motion stands still"
    lag_s = _lag_s(at_s, motion_mm, trace)
    if abs(lag_s) > LONGEST_LAG_S - LAG_STEP_S:
        return f"no lag within {1000 * LONGEST_LAG_S:.0f} ms fits: is the trace's time 0 known?"
    commanded_mm = trace.at(at_s - lag_s) - trace.at(np.array([zero_s - lag_s]))[0]
    error_mm = motion_mm - commanded_mm
    return MotionAgreement(
        lag_s=lag_s,
        ratio=float(np.polyfit(commanded_mm, motion_mm, 1)[0]),
        offset_mm=float(error_mm.mean()),
        mean_error_mm=float(np.abs(error_mm).mean()),
        p95_error_mm=float(np.percentile(np.abs(error_mm), 95.0)),
        frames=int(is_told.sum()),
    )


def _lag_s(at_s: FloatArray, motion_mm: FloatArray, trace: CommandedTrace) -> float:
    """Find the lag at which the measured motion is most like the commanded, whatever its scale and level."""

    def unlike(lag_s: float) -> float:
        commanded = trace.at(at_s - lag_s)
        if np.ptp(commanded) < STILL_MM:
            return 1.0
        return -float(np.corrcoef(commanded, motion_mm)[0, 1])

    coarse = np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + 0.5 * LAG_STEP_S, LAG_STEP_S)
    best = float(coarse[int(np.argmin([unlike(lag_s) for lag_s in coarse.tolist()]))])
    span = (max(best - LAG_STEP_S, -LONGEST_LAG_S), min(best + LAG_STEP_S, LONGEST_LAG_S))
    return float(minimize_scalar(unlike, bounds=span, method="bounded").x)
