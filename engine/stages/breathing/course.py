"""The breath under way: what is gathered from one end of inhale until the next is known. In mm and s."""

import math
from dataclasses import dataclass, replace

from engine.stages.breathing.habit import Cycle
from engine.stages.breathing.shape import Path, shape_of
from engine.stages.breathing.turns import RISING, Turns

MIN_SPEED_MM_S = 0.1
MAX_PATH = 300
"""Half a minute, longer than any breath."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """What is remembered of it.

    Attributes
    ----------
    peak_s, fell_s
        The end of inhale it began with, and when that was known; None before the first.
    down_share
        Time from there until then, as a share of a breath: known when the breath is complete.
    trough, trough_s, rose_s
        The end of exhale, and when the rise after it was known; None before.
    low
        Lowest level since the end of inhale; ``inf`` before there is one.
    speed
        Fastest rise since the end of exhale [mm/s].
    rose
        The level at which the rise was known.
    path
        The level since the end of inhale, ten times a second.
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


def gone_on(course: Course, level: float | None, speed: float, now: tuple[float, float]) -> Course:
    """Take a closed bin: its level, when it is known, its speed, and the time and level of this moment."""
    low = course.low if level is None or course.rose_s is not None else min(course.low, level)
    return replace(course, low=low, speed=max(course.speed, speed), path=(*course.path, now)[-MAX_PATH:])


def lifted(course: Course, by: float) -> Course:
    """Move all levels [mm]."""
    path = tuple((at_s, level + by) for at_s, level in course.path)
    return replace(course, trough=course.trough + by, low=course.low + by, rose=course.rose + by, path=path)


def turned(course: Course, turns: Turns, now_s: float) -> tuple[Course, Cycle | None]:
    """Take a turn; return the breath that it completes."""
    if turns.way == RISING:
        begun = replace(course, trough=turns.low, trough_s=turns.low_s, rose_s=now_s, rose=turns.high, speed=0.0)
        return begun, None
    cycle = _completed(course, turns)
    path = tuple(one for one in course.path if one[0] >= turns.high_s)
    return Course(peak_s=turns.high_s, fell_s=now_s, path=path), cycle


def _completed(course: Course, turns: Turns) -> Cycle | None:
    peak_s, rose_s = course.peak_s, course.rose_s
    if peak_s is None or rose_s is None or turns.high_s <= peak_s or not math.isfinite(course.low):
        return None
    period_s = turns.high_s - peak_s
    rise = turns.high - course.trough
    shape = shape_of(course.path, peak_s, turns.high_s, course.low, turns.high)
    if shape is None:
        return None
    return Cycle(
        start_s=peak_s,
        end_s=turns.high_s,
        low=course.low,
        low_s=course.trough_s,
        rise=rise,
        up_share=min(max((rose_s - peak_s) / period_s, 0.05), 0.95),
        down_share=min(max((course.fell_s - peak_s) / period_s, 0.02), 0.6),
        speed=max(course.speed, MIN_SPEED_MM_S) / rise,
        shape=shape,
    )
