"""What is known of a patient's breathing: the breaths seen, what is usual, where the end of exhale lies. In mm and s.

It changes where the signal turns and ten times a second, not with every frame.
"""

import math
from dataclasses import dataclass, replace
from statistics import median

from engine.stages.breathing import events as judging
from engine.stages.breathing.habit import Cycle, Habit, habit_of, level_scatter, regularity_of, with_cycle

LEARNED_CYCLES = 3
KEPT_LOWS = 3
MISSING_AT_FIRST = 2
CONSISTENT_BELOW = 1.3
TOO_EARLY = "too little seen yet"
Lows = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """What is known.

    Attributes
    ----------
    cycles, habit, regularity, scatter
        The last complete breaths, what is usual, how alike they are, and how their ends of exhale scatter.
    lows, speed
        Time and level of the last ends of exhale, and how fast they move [mm/s].
    learned, correction
        Where the end of exhale was learned, or was last set to be, None before; and how far from there a person has
        confirmed that it is now.
    missing, why
        How many consistent breaths have to be seen before a phase is told, and why.
    quick, quick_s, quick_last_s
        Points for quick inhales, when the first of them was, and the last.
    watched_s, points
        End of a quick inhale whose exhale is watched, and the points it is worth; None when there is none.
    disturbed_s
        When something last disturbed the breath.
    """

    cycles: tuple[Cycle, ...] = ()
    habit: Habit | None = None
    regularity: float | None = None
    scatter: float = 0.0
    lows: Lows = ()
    speed: float | None = None
    learned: float | None = None
    correction: float = 0.0
    missing: int = MISSING_AT_FIRST
    why: str = TOO_EARLY
    quick: int = 0
    quick_s: float = 0.0
    quick_last_s: float = 0.0
    watched_s: float | None = None
    points: int = 0
    disturbed_s: float = -math.inf

    @property
    def rise(self) -> float:
        """How deep a usual breath is [mm]; 0 where it is not known."""
        return 0.0 if self.habit is None else self.habit.rise

    @property
    def expected(self) -> float | None:
        """The level of the end of exhale that drift is told against; None while it is not known."""
        return None if self.learned is None else self.learned + self.correction

    @property
    def low(self) -> float:
        """Level of the last end of exhale; NaN before the first."""
        return self.lows[-1][1] if self.lows else math.nan


def moved(known: Known, by: float) -> Known:
    """Move all levels [mm]."""
    return replace(
        known,
        cycles=tuple(replace(cycle, low=cycle.low + by) for cycle in known.cycles),
        lows=tuple((at, low + by) for at, low in known.lows),
        learned=None if known.learned is None else known.learned + by,
    )


def with_low(known: Known, at_s: float, low: float) -> Known:
    """Take the end of an exhale; the inhale that begins ends any watch."""
    if not math.isfinite(low):
        return replace(known, watched_s=None)
    lows = (*known.lows, (at_s, low))[-KEPT_LOWS:]
    return replace(known, lows=lows, speed=_slope(lows), watched_s=None)


def with_inhale(known: Known, now_s: float, speed: float, rise: float) -> Known:
    """Judge an inhale that has ended by its speed [mm/s] for its rise; it counts once its exhale has taken its time."""
    habit = known.habit
    if habit is None:
        return known
    times = speed / (habit.speed * rise) if rise > judging.QUICK_RISE_SHARE * habit.rise else 0.0
    if times < judging.QUICK_TIMES:
        return replace(known, quick=max(0, known.quick - 1), watched_s=None)
    return replace(known, watched_s=now_s, points=1 if times < judging.VERY_QUICK_TIMES else 2)


def with_breath(known: Known, cycle: Cycle) -> Known:
    """Take a complete breath."""
    is_disturbed = known.disturbed_s >= cycle.start_s
    cycles = with_cycle(known.cycles, replace(cycle, is_disturbed=is_disturbed), known.habit)
    is_consistent = cycles[-1].odd < CONSISTENT_BELOW and not is_disturbed
    calm = [one for one in cycles if not one.is_disturbed]
    learned = known.learned
    if learned is None and len(calm) >= LEARNED_CYCLES:
        learned = median(one.low for one in calm)
    return replace(
        known,
        cycles=cycles,
        habit=habit_of(cycles),
        regularity=regularity_of(cycles),
        scatter=level_scatter(calm),
        learned=learned,
        missing=max(0, known.missing - 1) if is_consistent else max(1, known.missing),
    )


def without_since(known: Known, from_s: float) -> Known:
    """Take back what was made of the signal since then."""
    cycles = tuple(cycle for cycle in known.cycles if cycle.end_s < from_s)
    lows = tuple((at, low) for at, low in known.lows if at < from_s)
    return replace(known, cycles=cycles, lows=lows)


def doubting(known: Known, missing: int, why: str) -> Known:
    """Tell no phase before so many more consistent breaths."""
    return replace(known, missing=max(missing, known.missing), why=why)


def watched(known: Known, now_s: float) -> Known:
    """Count a quick inhale whose exhale has lasted; forget those of long ago."""
    if known.habit is None:
        return known
    if known.watched_s is not None and now_s - known.watched_s > judging.QUICK_WAIT_SHARE * known.habit.period_s:
        return replace(
            known,
            quick=min(judging.MOST_QUICK, known.quick + known.points),
            quick_s=known.watched_s if known.quick == 0 else known.quick_s,
            quick_last_s=now_s,
            watched_s=None,
        )
    if known.quick and now_s - known.quick_last_s > judging.TALK_OVER_PERIODS * known.habit.period_s:
        return replace(known, quick=0)
    return known


def _slope(lows: Lows) -> float | None:
    """Slope of the line that fits the last ends of exhale best; None for under three."""
    if len(lows) < 3:
        return None
    mean_s = sum(at for at, _ in lows) / len(lows)
    mean = sum(low for _, low in lows) / len(lows)
    spread = sum((at - mean_s) ** 2 for at, _ in lows)
    return sum((at - mean_s) * (low - mean) for at, low in lows) / spread if spread > 0.0 else None
