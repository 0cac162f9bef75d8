"""A patient's usual breath: medians of complete breaths, from one end of inhale to the next.

A disturbed breath (cough, sigh, speech, pause) is kept but does not enter the medians. In mm and s.

The shape of a breath: height of the signal at each phase, 0 at the end of exhale, 1 at the end of inhale.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from engine.core.replacing import replace

SHAPE_POINTS = 20
MIN_SEEN = 4
Path = tuple[tuple[float, float], ...]
"""Pairs of time [s], ascending, and level [mm]."""
Shape = tuple[float, ...]
"""Heights at equal steps of phase from 0 %, the end of inhale; periodic."""
KEPT_CYCLES = 8
USUAL_CYCLES = 6
RECENT_CYCLES = 4
JUDGED_CYCLES = 5
PERIOD_SPREAD = 0.27
AMPLITUDE_SPREAD = 0.27
LEVEL_SPREAD = 0.30
"""Relative deviations of period, amplitude and level that count as 1 in a breath's deviation (`Cycle.deviation`)."""
MAX_ODD = 2.2
SIGMA_OF_MEDIAN = 1.4826
SECOND_DIFFERENCE_GAIN = 6.0**0.5


def shape_of(path: Path, start_s: float, end_s: float, low: float, high: float) -> Shape | None:
    """Return the shape of the breath between two ends of inhale [s]; None if the path has too few points."""
    if len(path) < MIN_SEEN or not (end_s > start_s and high > low):
        return None
    heights, before = [], 0
    for number in range(SHAPE_POINTS):
        at_s = start_s + (end_s - start_s) * number / SHAPE_POINTS
        while before + 2 < len(path) and path[before + 1][0] <= at_s:
            before += 1
        (first_s, first), (next_s, following) = path[before], path[before + 1]
        share = min(max((at_s - first_s) / (next_s - first_s), 0.0), 1.0)
        heights.append((first + share * (following - first) - low) / (high - low))
    return tuple(heights)


def usual_shape(shapes: list[Shape]) -> Shape:
    """Return the median of one or more shapes at each phase."""
    return tuple(median(heights) for heights in zip(*shapes, strict=True))


def heights_at(shape: Shape, *percents: float) -> list[float]:
    """Return the height at each phase [%], linearly interpolated; a phase may exceed 100."""
    heights = []
    for percent in percents:
        place = (percent % 100.0) * len(shape) / 100.0
        before = int(place) % len(shape)
        share = place - int(place)
        heights.append(shape[before] + share * (shape[(before + 1) % len(shape)] - shape[before]))
    return heights


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """One complete breath.

    Attributes
    ----------
    start_s, end_s
        Times of the ends of inhale before and after [s].
    low, low_s
        Level [mm] and time [s] of the end of exhale between them.
    rise
        Rise from there to the end of inhale [mm].
    up_share, down_share
        Phases at which the rise and the fall were detected, as shares of the breath.
    speed
        Fastest rise as a share of ``rise`` [1/s].
    shape
        Height of the signal at each phase.
    deviation
        Squared deviation from the usual breath.
    is_disturbed
        Whether an event disturbed it.
    """

    start_s: float
    end_s: float
    low: float
    low_s: float
    rise: float
    up_share: float
    down_share: float
    speed: float
    shape: Shape
    deviation: float = 0.0
    is_disturbed: bool = False

    @property
    def period_s(self) -> float:
        """Length [s]."""
        return self.end_s - self.start_s


@dataclass(frozen=True, slots=True, kw_only=True)
class BreathingHabit:
    """The usual breath: medians of the last undisturbed breaths, in the fields of `Cycle`."""

    period_s: float
    rise: float
    up_share: float
    down_share: float
    speed: float
    period_spread: float
    shape: Shape


def habit_of(cycles: Sequence[Cycle]) -> BreathingHabit | None:
    """Return the usual breath; None before the first complete one."""
    usual = [cycle for cycle in cycles if not cycle.is_disturbed][-USUAL_CYCLES:] or list(cycles)[-USUAL_CYCLES:]
    if not usual:
        return None
    period_s = median(cycle.period_s for cycle in usual[-RECENT_CYCLES:])
    return BreathingHabit(
        period_s=period_s,
        rise=median(cycle.rise for cycle in usual),
        up_share=median(cycle.up_share for cycle in usual),
        down_share=median(cycle.down_share for cycle in usual),
        speed=median(cycle.speed for cycle in usual),
        period_spread=median(abs(cycle.period_s - period_s) for cycle in usual) * SIGMA_OF_MEDIAN / period_s,
        shape=usual_shape([cycle.shape for cycle in usual]),
    )


def with_cycle(cycles: tuple[Cycle, ...], cycle: Cycle, habit: BreathingHabit | None) -> tuple[Cycle, ...]:
    """Append a breath, with its deviation from the usual and the previous breath."""
    if habit is not None:
        cycle = replace(cycle, deviation=_squared_deviation(cycle, habit, cycles[-2:]))
    return (*cycles, cycle)[-KEPT_CYCLES:]


def regularity_of(cycles: Sequence[Cycle]) -> float | None:
    """Similarity of the last breaths to the previous ones, 0 to 1; None before three breaths."""
    deviations = [cycle.deviation for cycle in cycles[1:] if not cycle.is_disturbed][-JUDGED_CYCLES:]
    if len(deviations) < 2:
        return None
    return 1.0 / (1.0 + sum(deviations) / len(deviations))


def level_scatter(cycles: Sequence[Cycle]) -> float:
    """Return the standard deviation of the end of exhale about a steady drift [mm]; 0 for under three breaths."""
    lows = [cycle.low for cycle in cycles]
    seconds = [
        abs(before - 2.0 * middle + after)
        for before, middle, after in zip(lows[:-2], lows[1:-1], lows[2:], strict=True)
    ]
    return SIGMA_OF_MEDIAN * median(seconds) / SECOND_DIFFERENCE_GAIN if seconds else 0.0


def _squared_deviation(cycle: Cycle, habit: BreathingHabit, before: tuple[Cycle, ...]) -> float:
    """Squared deviation from the usual or the previous breath, the smaller one, so that a new pattern is adopted."""
    by_habit = _deviation(cycle, habit.period_s, habit.rise)
    by_last = _deviation(cycle, before[-1].period_s, before[-1].rise) if before else MAX_ODD
    # Second difference of the level: a steady drift is not irregular.
    level = cycle.low - 2.0 * before[1].low + before[0].low if len(before) == 2 else 0.0
    return min(MAX_ODD, min(by_habit, by_last) + (0.5 * level / habit.rise / LEVEL_SPREAD) ** 2)


def _deviation(cycle: Cycle, period_s: float, rise: float) -> float:
    longer = math.log(cycle.period_s / period_s) / PERIOD_SPREAD
    deeper = math.log(cycle.rise / rise) / AMPLITUDE_SPREAD
    return longer**2 + deeper**2
