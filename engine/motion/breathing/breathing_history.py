"""History of a patient's breathing: last breaths, usual breath, and level of the end of exhale. In mm and s.

It is updated at turning points and ten times a second, not in every frame.
"""

import math
from dataclasses import dataclass
from statistics import median

from engine.core.replacing import replace
from engine.core.sentences import say
from engine.motion.breathing import events as event_rules
from engine.motion.breathing.breathing_habit import (
    BreathingHabit,
    Cycle,
    habit_of,
    level_scatter,
    regularity_of,
    with_cycle,
)

LEARNED_CYCLES = 3
KEPT_LOWS = 3
INITIAL_BREATHS = 2
CONSISTENT_BELOW = 1.3
TOO_EARLY = say("too little seen yet")
Lows = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class BreathingHistory:
    """State of the history.

    Attributes
    ----------
    cycles, habit, regularity, scatter
        The last complete breaths, the usual breath, their similarity, and the scatter of their ends of exhale [mm].
    lows, speed
        Times and levels of the last ends of exhale, and their drift [mm/s].
    learned, correction
        Level of the end of exhale as learned or last set, None before; and the change since then that an operator
        has confirmed.
    breaths_needed, reason
        Number of consistent breaths still needed before a phase is reported, and the reason.
    quick, quick_s, quick_last_s
        Score of fast inhales, and the times of the first and the last of them.
    watched_s, points
        End of a fast inhale whose exhale is being timed, None if there is none; and its score.
    disturbed_s
        Time of the last disturbance.
    """

    cycles: tuple[Cycle, ...] = ()
    habit: BreathingHabit | None = None
    regularity: float | None = None
    scatter: float = 0.0
    lows: Lows = ()
    speed: float | None = None
    learned: float | None = None
    correction: float = 0.0
    breaths_needed: int = INITIAL_BREATHS
    reason: str = TOO_EARLY
    quick: int = 0
    quick_s: float = 0.0
    quick_last_s: float = 0.0
    watched_s: float | None = None
    points: int = 0
    disturbed_s: float = -math.inf

    @property
    def rise(self) -> float:
        """Depth of a usual breath [mm]; 0 if unknown."""
        return 0.0 if self.habit is None else self.habit.rise

    @property
    def expected(self) -> float | None:
        """Level of the end of exhale that drift is measured from [mm]; None if unknown."""
        return None if self.learned is None else self.learned + self.correction

    @property
    def low(self) -> float:
        """Level of the last end of exhale [mm]; NaN before the first."""
        return self.lows[-1][1] if self.lows else math.nan


def shifted_history(history: BreathingHistory, by: float) -> BreathingHistory:
    """Shift all levels by ``by`` [mm]."""
    return replace(
        history,
        cycles=tuple(replace(cycle, low=cycle.low + by) for cycle in history.cycles),
        lows=tuple((at, low + by) for at, low in history.lows),
        learned=None if history.learned is None else history.learned + by,
    )


def with_low(history: BreathingHistory, at_s: float, low: float) -> BreathingHistory:
    """Add an end of exhale; it ends the timing of a fast inhale's exhale."""
    if not math.isfinite(low):
        return replace(history, watched_s=None)
    lows = (*history.lows, (at_s, low))[-KEPT_LOWS:]
    return replace(history, lows=lows, speed=_slope(lows), watched_s=None)


def with_inhale(history: BreathingHistory, now_s: float, speed: float, rise: float) -> BreathingHistory:
    """Score a completed inhale by its speed [mm/s] and rise [mm]; it counts after a sufficiently long exhale."""
    habit = history.habit
    if habit is None:
        return history
    times = speed / (habit.speed * rise) if rise > event_rules.QUICK_RISE_SHARE * habit.rise else 0.0
    if times < event_rules.QUICK_TIMES:
        return replace(history, quick=max(0, history.quick - 1), watched_s=None)
    return replace(history, watched_s=now_s, points=1 if times < event_rules.VERY_QUICK_TIMES else 2)


def with_breath(history: BreathingHistory, cycle: Cycle) -> BreathingHistory:
    """Add a complete breath and update the usual one."""
    is_disturbed = history.disturbed_s >= cycle.start_s
    cycles = with_cycle(history.cycles, replace(cycle, is_disturbed=is_disturbed), history.habit)
    is_consistent = cycles[-1].deviation < CONSISTENT_BELOW and not is_disturbed
    calm = [one for one in cycles if not one.is_disturbed]
    learned = history.learned
    if learned is None and len(calm) >= LEARNED_CYCLES:
        learned = median(one.low for one in calm)
    return replace(
        history,
        cycles=cycles,
        habit=habit_of(cycles),
        regularity=regularity_of(cycles),
        scatter=level_scatter(calm),
        learned=learned,
        breaths_needed=max(0, history.breaths_needed - 1) if is_consistent else max(1, history.breaths_needed),
    )


def truncated(history: BreathingHistory, from_s: float) -> BreathingHistory:
    """Remove breaths and ends of exhale since ``from_s``."""
    cycles = tuple(cycle for cycle in history.cycles if cycle.end_s < from_s)
    lows = tuple((at, low) for at, low in history.lows if at < from_s)
    return replace(history, cycles=cycles, lows=lows)


def suspending(history: BreathingHistory, breaths_needed: int, reason: str) -> BreathingHistory:
    """Suspend the phase until ``breaths_needed`` more consistent breaths, with a reason."""
    return replace(history, breaths_needed=max(breaths_needed, history.breaths_needed), reason=reason)


def timed(history: BreathingHistory, now_s: float) -> BreathingHistory:
    """Count a fast inhale whose exhale has lasted long enough; expire old ones."""
    if history.habit is None:
        return history
    if (
        history.watched_s is not None
        and now_s - history.watched_s > event_rules.QUICK_WAIT_SHARE * history.habit.period_s
    ):
        return replace(
            history,
            quick=min(event_rules.MOST_QUICK, history.quick + history.points),
            quick_s=history.watched_s if history.quick == 0 else history.quick_s,
            quick_last_s=now_s,
            watched_s=None,
        )
    if history.quick and now_s - history.quick_last_s > event_rules.TALK_OVER_PERIODS * history.habit.period_s:
        return replace(history, quick=0)
    return history


def _slope(lows: Lows) -> float | None:
    """Slope of the line fitted to the last ends of exhale [mm/s]; None for fewer than three."""
    if len(lows) < 3:
        return None
    mean_s = sum(at for at, _ in lows) / len(lows)
    mean = sum(low for _, low in lows) / len(lows)
    spread = sum((at - mean_s) ** 2 for at, _ in lows)
    return sum((at - mean_s) * (low - mean) for at, low in lows) / spread if spread > 0.0 else None
