"""The sine method: delays of beam on and beam off, from a phantom that moves in sines.

A window with one edge inside the sine's range contains one interval per cycle, centred on the sine's turning point. A
gate with the delays ``on`` and ``off`` shifts the middle of its interval by (on + off) / 2, independent of the level at
which it switches. With sines of several periods T, of which a share ``a`` is inside the window, the intervals have the
lengths ``a T + (off - on)``: the intercept of a line through lengths against periods is the difference of the delays,
also independent of the level.

Source: E. S. Worm, R. Hansen, P. Poulsen et al., gated proton beams (ESTRO 2021).
Times are on the trace's clock [s]; intervals are pairs (on, off).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from engine.core.frames import FloatArray
from engine.qa.trace import CommandedTrace

Grid = npt.NDArray[np.float64]
STEP_S = 0.001
MAX_MISFIT = 0.03
"""Largest root mean square deviation of a cycle from a sine, as a share of its amplitude."""

FEWEST_CYCLES = 5
MIN_WHOLE_SHARE = 0.75
"""Smallest share of the cycles that must have exactly one interval each."""

MIN_PERIOD_RATIO = 1.2
"""Smallest ratio of longest to shortest period for which a line through lengths against periods is fitted."""

_SIGMA_OF_MAD = 1.4826
_FAR_SIGMAS, _NEAR_S, _ROUNDS = 4.0, 0.05, 3
"""A length farther from the line than this has another cause, such as a lost frame, and is left out of the fit."""
_MEDIAN_ERROR = 1.2533
_FITTED_SHARE, _PERIOD_SLACK = 0.45, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """One sine of the trace [s]: its interval inside the window, its bounding turning points, and its period."""

    on_s: float
    off_s: float
    begins_s: float
    ends_s: float
    period_s: float

    @property
    def middle_s(self) -> float:
        """Middle of the interval inside the window: the sine's turning point [s]."""
        return 0.5 * (self.on_s + self.off_s)

    @property
    def length_s(self) -> float:
        """Length of the interval inside the window [s]."""
        return self.off_s - self.on_s

    @property
    def span_s(self) -> float:
        """Time between its bounding turning points [s]: an estimate of the period where the neighbours differ."""
        return self.ends_s - self.begins_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A figure with its standard error."""

    value: float
    error: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GateTiming:
    """Result of the sine method.

    Attributes
    ----------
    mean_s, difference_s
        (on + off) / 2, and off - on [s].
    duty_change
        Duty cycle of the beam less that of the sines inside the window, as a share of the cycles' time.
    cycles
        Number of cycles with exactly one interval.
    has_periods
        Whether the difference comes from lengths against periods; otherwise it comes from the lengths alone, and
        includes an error of the level.
    pairs
        Each cycle that has exactly one interval, with that interval.
    """

    mean_s: Estimate
    difference_s: Estimate
    duty_change: float
    cycles: int
    has_periods: bool
    pairs: tuple[tuple[Cycle, tuple[float, float]], ...]

    @property
    def on_s(self) -> Estimate:
        """Delay of beam on [s]."""
        return self._combined(-0.5)

    @property
    def off_s(self) -> Estimate:
        """Delay of beam off [s]."""
        return self._combined(0.5)

    def _combined(self, share: float) -> Estimate:
        error = float(np.hypot(self.mean_s.error, 0.5 * self.difference_s.error))
        return Estimate(value=self.mean_s.value + share * self.difference_s.value, error=error)


def find_cycles(trace: CommandedTrace, window_mm: tuple[float, float], from_s: float, to_s: float) -> list[Cycle]:
    """Find the cycles of a trace between two times [s] that are sines, with their interval inside the window."""
    first, last = trace.span_s
    times = np.arange(max(from_s, first), min(to_s, last), STEP_S)
    times = times[times <= last]
    if len(times) < FEWEST_CYCLES:
        return []
    position = trace.at(times)
    lower, upper = window_mm
    is_low = position.min() >= lower
    height = position if is_low else -position
    edge = upper if is_low else -lower
    inside = _intervals(times, height, edge)
    found = []
    for before, now, after in zip(inside, inside[1:], inside[2:], strict=False):
        begins_s = _turning_point_s(times, height, before[1], now[0])
        ends_s = _turning_point_s(times, height, now[1], after[0])
        cycle = Cycle(on_s=now[0], off_s=now[1], begins_s=begins_s, ends_s=ends_s, period_s=ends_s - begins_s)
        found.append(_as_sine(cycle, times, position))
    return [cycle for cycle in found if cycle is not None]


def time_gate_by_sines(cycles: Sequence[Cycle], intervals: Sequence[tuple[float, float]]) -> GateTiming | str:
    """Compare the beam's intervals with the sines'; return the reason, a sentence, where that is not possible."""
    if len(cycles) < FEWEST_CYCLES:
        return f"{len(cycles)} cycles of the commanded trace are sines: at least {FEWEST_CYCLES} are needed"
    pairs = [
        (cycle, found[0])
        for cycle in cycles
        if len(found := [pair for pair in intervals if cycle.begins_s <= 0.5 * sum(pair) < cycle.ends_s]) == 1
    ]
    if len(pairs) < MIN_WHOLE_SHARE * len(cycles):
        return (
            f"in {len(pairs)} of {len(cycles)} cycles the beam went on exactly once: at least three quarters are needed"
        )
    shifts = np.array([0.5 * (on_s + off_s) - cycle.middle_s for cycle, (on_s, off_s) in pairs])
    difference, has_periods = _difference(pairs)
    return GateTiming(
        mean_s=_median(shifts),
        difference_s=difference,
        duty_change=_duty(cycles, intervals) - _duty(cycles, [(cycle.on_s, cycle.off_s) for cycle in cycles]),
        cycles=len(pairs),
        has_periods=has_periods,
        pairs=tuple(pairs),
    )


def _difference(pairs: Sequence[tuple[Cycle, tuple[float, float]]]) -> tuple[Estimate, bool]:
    """Intercept of the line through lengths against periods; with one period, the median difference of the lengths."""
    periods = np.array([cycle.period_s for cycle, _ in pairs])
    lengths = np.array([off_s - on_s for _, (on_s, off_s) in pairs])
    if periods.max() < MIN_PERIOD_RATIO * periods.min():
        return _median(lengths - np.array([cycle.length_s for cycle, _ in pairs])), False
    is_kept = np.ones(len(pairs), dtype=np.bool_)
    for _ in range(_ROUNDS):
        slope, intercept = np.polyfit(periods[is_kept], lengths[is_kept], 1)
        distance_s = np.abs(lengths - slope * periods - intercept)
        is_kept = distance_s <= max(_FAR_SIGMAS * _SIGMA_OF_MAD * float(np.median(distance_s)), _NEAR_S)
    spread = float(np.sqrt(np.sum(np.square(distance_s[is_kept])) / max(is_kept.sum() - 2, 1)))
    reach = float(np.mean(periods[is_kept] ** 2) / np.var(periods[is_kept]))
    return Estimate(value=float(intercept), error=spread * float(np.sqrt(reach / is_kept.sum()))), True


def _median(values: FloatArray) -> Estimate:
    middle = float(np.median(values))
    spread = _SIGMA_OF_MAD * float(np.median(np.abs(values - middle)))
    return Estimate(value=middle, error=_MEDIAN_ERROR * spread / float(np.sqrt(len(values))))


def _duty(cycles: Sequence[Cycle], intervals: Sequence[tuple[float, float]]) -> float:
    """Share of the cycles' time inside the intervals, 0 to 1."""
    inside = sum(
        max(0.0, min(off_s, cycle.ends_s) - max(on_s, cycle.begins_s)) for cycle in cycles for on_s, off_s in intervals
    )
    return inside / sum(cycle.span_s for cycle in cycles)


def _intervals(times: Grid, height: FloatArray, edge: float) -> list[tuple[float, float]]:
    """Intervals with ``height`` below the edge whose both crossings lie in ``times``, as pairs [s]."""
    above = height - edge
    flips = np.flatnonzero((above[1:] <= 0.0) != (above[:-1] <= 0.0))
    at = times[flips] + STEP_S * above[flips] / (above[flips] - above[flips + 1])
    if len(flips) and above[flips[0]] <= 0.0:
        at = at[1:]  # the first interval began before the first sample
    return [(float(on), float(off)) for on, off in zip(at[::2], at[1::2], strict=False)]


def _turning_point_s(times: Grid, height: FloatArray, from_s: float, to_s: float) -> float:
    """Time of the turning point between two times [s]: the vertex of a parabola through the top."""
    is_between = (times >= from_s) & (times <= to_s)
    at, level = times[is_between], height[is_between]
    top = level >= level.max() - 0.01 * float(np.ptp(level))
    middle_s = float(at[top].mean())
    bend, slope, _ = np.polyfit(at[top] - middle_s, level[top], 2) if top.sum() >= 3 else (0.0, 0.0, 0.0)
    vertex_s = middle_s - 0.5 * float(slope / bend) if bend < 0.0 else middle_s
    return min(max(vertex_s, from_s), to_s)  # the curvature of a level top is rounding noise


def _as_sine(cycle: Cycle, times: Grid, position: FloatArray) -> Cycle | None:
    """Fit a sine around the turning point and set the cycle's period to it; None where the misfit is too large."""
    within = np.abs(times - cycle.middle_s) <= _FITTED_SHARE * cycle.span_s
    offset_s, level_mm = times[within] - cycle.middle_s, position[within]

    def misfit(period_s: float) -> float:
        """Root mean square of the residual of a sine of this period, as a share of the amplitude."""
        shape = np.column_stack([np.cos(2.0 * np.pi * offset_s / period_s), np.ones_like(offset_s)])
        (amplitude_mm, middle_mm), *_ = np.linalg.lstsq(shape, level_mm, rcond=None)
        rest_mm = level_mm - shape @ (amplitude_mm, middle_mm)
        return float(np.sqrt(np.mean(np.square(rest_mm))) / max(abs(float(amplitude_mm)), 1e-9))

    span = (1.0 - _PERIOD_SLACK) * cycle.span_s, (1.0 + _PERIOD_SLACK) * cycle.span_s
    best = minimize_scalar(misfit, bounds=span, method="bounded")
    return replace(cycle, period_s=float(best.x)) if best.fun <= MAX_MISFIT else None
