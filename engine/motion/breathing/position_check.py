"""Checks the level and its motion against the phase, with the patient's usual breath.

The phase is computed from time only. A regular breath passes the checks, also one a third shallower or half as deep
again; a breath that stops, slows down, speeds up or is shifted does not. In mm, s and per cent.

The current breath: data from one end of inhale until the next is detected. In mm and s.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from engine.core.replacing import replace
from engine.motion.breathing.breathing_habit import BreathingHabit, Cycle, Path, heights_at, shape_of
from engine.motion.breathing.cycles import FALLING, RISING, TurningPoints

MIN_SPEED_MM_S = 0.1
MAX_PATH = 300
"""Half a minute at ten points per second, longer than any breath."""
EARLY_OR_LATE = 7.0
"""Tolerance of the phase when the level is compared with it [% of a breath]; regular breathing stays within 5."""
LEVEL_SHARE = 0.1
LEVEL_MM = 0.3
"""Tolerance of the level: a share of a usual breath, plus an allowance for heartbeat and noise [mm]."""
LEAST_ADVANCE = 0.6
MOST_ADVANCE = 1.7
"""Bounds of an inhale's advance, as shares of a usual one's advance at that phase."""
WAY_S = 0.25
LEAST_WAY = 0.35
WAY_OFF = 5.0
"""Time over which the motion is compared [s], its least share of the usual motion, and the phase tolerance [%]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentBreath:
    """State of the current breath.

    Attributes
    ----------
    peak_s, fell_s
        Time of the end of inhale at its start, None before the first; and when the fall was detected.
    trough, trough_s, rose_s
        Level and time of the end of exhale, and when the rise after it was detected; None before.
    low
        Lowest level since the end of inhale; ``inf`` before the first bin.
    speed
        Fastest rise since the end of exhale [mm/s].
    rose
        Level at which the rise was detected.
    path
        Times and levels since the end of inhale, ten per second.
    """

    peak_s: float | None = None
    fell_s: float = 0.0
    trough: float = math.nan
    trough_s: float = 0.0
    rose_s: float | None = None
    low: float = math.inf
    speed: float = 0.0
    rose: float = math.nan
    path: Path = ()


def with_bin(current: CurrentBreath, level: float | None, speed: float, now: tuple[float, float]) -> CurrentBreath:
    """Add a closed bin: its level, if known, its speed, and the current time and level."""
    low = current.low if level is None or current.rose_s is not None else min(current.low, level)
    return replace(current, low=low, speed=max(current.speed, speed), path=(*current.path, now)[-MAX_PATH:])


def shifted_breath(current: CurrentBreath, by: float) -> CurrentBreath:
    """Shift all levels by ``by`` [mm]."""
    path = tuple((at_s, level + by) for at_s, level in current.path)
    return replace(current, trough=current.trough + by, low=current.low + by, rose=current.rose + by, path=path)


def with_turn(current: CurrentBreath, turns: TurningPoints, now_s: float) -> tuple[CurrentBreath, Cycle | None]:
    """Process a turning point; return the new state and the breath that it completes, if any."""
    if turns.direction == RISING:
        started = replace(current, trough=turns.low, trough_s=turns.low_s, rose_s=now_s, rose=turns.high, speed=0.0)
        return started, None
    cycle = _completed(current, turns)
    path = tuple(one for one in current.path if one[0] >= turns.high_s)
    return CurrentBreath(peak_s=turns.high_s, fell_s=now_s, path=path), cycle


def _completed(current: CurrentBreath, turns: TurningPoints) -> Cycle | None:
    peak_s, rose_s = current.peak_s, current.rose_s
    if peak_s is None or rose_s is None or turns.high_s <= peak_s or not math.isfinite(current.low):
        return None
    period_s = turns.high_s - peak_s
    rise = turns.high - current.trough
    shape = shape_of(current.path, peak_s, turns.high_s, current.low, turns.high)
    if shape is None:
        return None
    return Cycle(
        start_s=peak_s,
        end_s=turns.high_s,
        low=current.low,
        low_s=current.trough_s,
        rise=rise,
        up_share=min(max((rose_s - peak_s) / period_s, 0.05), 0.95),
        down_share=min(max((current.fell_s - peak_s) / period_s, 0.02), 0.6),
        speed=max(current.speed, MIN_SPEED_MM_S) / rise,
        shape=shape,
    )


class ExpectedPosition(NamedTuple):
    """A moment of the signal: reported phase [%], last end of exhale and current level [mm]."""

    percent: float
    is_waiting: bool
    low: float
    seconds: float
    level: float


def contradicts_phase(
    moment: ExpectedPosition, habit: BreathingHabit, turns: TurningPoints, current: CurrentBreath
) -> bool:
    """Whether the level contradicts the phase; also True if there is nothing to compare with."""
    # Written so that NaN contradicts: every comparison with it is false.
    if turns.direction == FALLING:
        return not (
            _is_exhale(moment, habit, turns) and _is_under_way(moment, habit, FALLING, current, turns.high - moment.low)
        )
    if turns.direction == RISING:
        # From the rise to the next fall, across the end of inhale.
        is_past_end = moment.percent < 50.0 * (habit.down_share + habit.up_share)
        moment = moment._replace(percent=moment.percent + 100.0 * is_past_end)
        return not (
            _is_inhale(moment, habit, turns, current) and _is_under_way(moment, habit, RISING, current, habit.rise)
        )
    return True


def _is_exhale(moment: ExpectedPosition, habit: BreathingHabit, turns: TurningPoints) -> bool:
    """Whether the level fits an exhale at that phase; its depth is known from its start."""
    shape, slack = habit.shape, _slack_mm(habit)
    early, late = max(moment.percent - EARLY_OR_LATE, 0.0), moment.percent + EARLY_OR_LATE
    bottom = 100.0 * shape.index(min(shape)) / len(shape)
    at_rest = max(bottom, moment.percent - 2.0 * EARLY_OR_LATE)
    *heights, resting, falling = heights_at(shape, early, moment.percent, late, at_rest, min(early, bottom))
    if late >= bottom:
        heights.append(resting)  # a rest may be longer than usual; the phase itself limits its delay
    # Without a rise so far, levels of the rising flank do not count.
    has_risen = moment.level - turns.low > 0.5 * slack
    highest = max(heights) if has_risen else falling
    depth, height = turns.high - moment.low, moment.level - moment.low
    return depth * min(heights) - slack <= height <= depth * highest + slack


def _is_inhale(moment: ExpectedPosition, habit: BreathingHabit, turns: TurningPoints, current: CurrentBreath) -> bool:
    """Whether an inhale has advanced about as far as a usual one since its rise was detected."""
    slack, percent = _slack_mm(habit), moment.percent
    is_near_end = percent > 100.0 - EARLY_OR_LATE
    reached = turns.high if is_near_end else moment.level
    past, soon = max(percent - EARLY_OR_LATE, 100.0), min(percent + EARLY_OR_LATE, 100.0)
    started, now, later, fallen = heights_at(habit.shape, 100.0 * habit.up_share, min(percent, 100.0), soon, past)
    least = LEAST_ADVANCE * (habit.rise * (now - started)) - LEVEL_MM
    most = MOST_ADVANCE * (habit.rise * (later - started)) + slack
    is_far_enough = least <= reached - current.rose and moment.level - current.rose <= most
    is_going = is_near_end or moment.level >= turns.high - slack
    # A level that stays at the top does not fit a phase after the fall.
    is_low_enough = moment.level - moment.low <= (turns.high - moment.low) * fallen + slack
    return is_far_enough and is_going and is_low_enough


def _is_under_way(
    moment: ExpectedPosition, habit: BreathingHabit, direction: int, current: CurrentBreath, depth: float
) -> bool:
    """Whether the signal moves while a usual breath is on its flank; the phase itself limits a late turn."""
    since = None
    for one in reversed(current.path):
        if moment.seconds - one[0] >= WAY_S:
            since = one
            break
    if since is None or moment.is_waiting:
        return True
    back = 100.0 * (moment.seconds - since[0]) / habit.period_s
    percents = moment.percent - WAY_OFF, moment.percent, moment.percent + WAY_OFF
    early, now, late, before_early, before, before_late = heights_at(
        habit.shape, *percents, percents[0] - back, percents[1] - back, percents[2] - back
    )
    whole = direction * depth
    usual = min(whole * (early - before_early), whole * (now - before), whole * (late - before_late))
    least = LEAST_WAY * usual - LEVEL_MM
    return least <= 0.0 or direction * (moment.level - since[1]) >= least


def _slack_mm(habit: BreathingHabit) -> float:
    return LEVEL_SHARE * habit.rise + LEVEL_MM
