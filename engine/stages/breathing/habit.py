"""What is usual for a patient: complete breaths, from one end of inhale to the next, and their medians.

A breath that something disturbed (a cough, a sigh, speech, a pause) is kept but not learned from. In mm and s.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

from engine.stages.breathing.shape import Shape, usual_shape

KEPT_CYCLES = 8
USUAL_CYCLES = 6
RECENT_CYCLES = 4
JUDGED_CYCLES = 5
PERIOD_SPREAD = 0.27
AMPLITUDE_SPREAD = 0.27
LEVEL_SPREAD = 0.30
"""How far a breath may be from the usual, as a share of it, to be odd by one."""
MAX_ODD = 2.2
SIGMA_OF_MEDIAN = 1.4826
SECOND_DIFFERENCE_GAIN = 6.0**0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """One complete breath.

    Attributes
    ----------
    start_s, end_s
        The ends of inhale before and after.
    low, low_s
        Level of the end of exhale between them [mm], and when.
    rise
        From there to the end of inhale [mm].
    up_share, down_share
        When it was known to rise, and to fall, as a share of the breath from its start.
    speed
        Fastest rise as a share of ``rise`` [1/s].
    shape
        How high the signal stood at each phase.
    odd
        Square of how far it is from the usual.
    is_disturbed
        Something happened in it.
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
    odd: float = 0.0
    is_disturbed: bool = False

    @property
    def period_s(self) -> float:
        """How long it lasted."""
        return self.end_s - self.start_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Habit:
    """Medians of the last undisturbed breaths."""

    period_s: float
    rise: float
    up_share: float
    down_share: float
    speed: float
    period_spread: float
    shape: Shape


def habit_of(cycles: Sequence[Cycle]) -> Habit | None:
    """Return what is usual; None before the first complete breath."""
    usual = [cycle for cycle in cycles if not cycle.is_disturbed][-USUAL_CYCLES:] or list(cycles)[-USUAL_CYCLES:]
    if not usual:
        return None
    period_s = median(cycle.period_s for cycle in usual[-RECENT_CYCLES:])
    return Habit(
        period_s=period_s,
        rise=median(cycle.rise for cycle in usual),
        up_share=median(cycle.up_share for cycle in usual),
        down_share=median(cycle.down_share for cycle in usual),
        speed=median(cycle.speed for cycle in usual),
        period_spread=median(abs(cycle.period_s - period_s) for cycle in usual) * SIGMA_OF_MEDIAN / period_s,
        shape=usual_shape([cycle.shape for cycle in usual]),
    )


def with_cycle(cycles: tuple[Cycle, ...], cycle: Cycle, habit: Habit | None) -> tuple[Cycle, ...]:
    """Add a breath, judged by those before it."""
    if habit is not None:
        cycle = replace(cycle, odd=_odd(cycle, habit, cycles[-2:]))
    return (*cycles, cycle)[-KEPT_CYCLES:]


def regularity_of(cycles: Sequence[Cycle]) -> float | None:
    """How much the last breaths are like those before, 0 to 1; None before three."""
    judged = [cycle.odd for cycle in cycles[1:] if not cycle.is_disturbed][-JUDGED_CYCLES:]
    if len(judged) < 2:
        return None
    return 1.0 / (1.0 + sum(judged) / len(judged))


def level_scatter(cycles: Sequence[Cycle]) -> float:
    """Return how the end of exhale scatters beside any steady drift, standard deviation [mm]; 0 for under three."""
    lows = [cycle.low for cycle in cycles]
    seconds = [
        abs(before - 2.0 * middle + after)
        for before, middle, after in zip(lows[:-2], lows[1:-1], lows[2:], strict=True)
    ]
    return SIGMA_OF_MEDIAN * median(seconds) / SECOND_DIFFERENCE_GAIN if seconds else 0.0


def _odd(cycle: Cycle, habit: Habit, before: tuple[Cycle, ...]) -> float:
    """Judge a breath by the usual one and by the one before, whichever is more like it: a new habit is soon one."""
    by_habit = _apart(cycle, habit.period_s, habit.rise)
    by_last = _apart(cycle, before[-1].period_s, before[-1].rise) if before else MAX_ODD
    # By how much the level went elsewhere than it was going: a steady drift is not irregular.
    level = cycle.low - 2.0 * before[1].low + before[0].low if len(before) == 2 else 0.0
    return min(MAX_ODD, min(by_habit, by_last) + (0.5 * level / habit.rise / LEVEL_SPREAD) ** 2)


def _apart(cycle: Cycle, period_s: float, rise: float) -> float:
    longer = math.log(cycle.period_s / period_s) / PERIOD_SPREAD
    deeper = math.log(cycle.rise / rise) / AMPLITUDE_SPREAD
    return longer**2 + deeper**2
