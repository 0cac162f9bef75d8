"""The current breath: data from one end of inhale until the next is detected. In mm and s."""

import math
from dataclasses import dataclass

from engine.core.replacing import replace
from engine.motion.breathing.breathing_habit import Cycle
from engine.motion.breathing.shape import Path, shape_of
from engine.motion.breathing.turning_points import RISING, TurningPoints

MIN_SPEED_MM_S = 0.1
MAX_PATH = 300
"""Half a minute at ten points per second, longer than any breath."""


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
