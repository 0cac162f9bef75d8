"""Detects the ends of inhale and exhale: an extreme is a turning point once the signal has left it by a threshold.

Averages a signal over bins of 0.1 s, and detects where it is at rest. In mm and s.
"""

import math
from dataclasses import dataclass

from engine.core.replacing import replace

RISING, FALLING, UNKNOWN = 1, -1, 0
BIN_S = 0.1
LEVEL_BINS = 6
"""The level is the mean over this many bins, about one heartbeat, which it averages out."""
SPEED_BINS = 3
STILL_SHARE = 0.2
MIN_STILL_MM = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class TurningPoints:
    """State of the detector: direction, and the extremes since the last turning point.

    Attributes
    ----------
    direction
        ``RISING`` until the next peak, ``FALLING`` until the next trough, ``UNKNOWN`` before the first turning point.
    high, high_s, low, low_s
        Extremes since the last turning point, and their times [s].
    turned_s
        When the last turning point was detected [s].
    """

    direction: int = UNKNOWN
    high: float = float("-inf")
    high_s: float = 0.0
    low: float = float("inf")
    low_s: float = 0.0
    turned_s: float = 0.0


def follow_turns(turns: TurningPoints, seconds: float, value: float, threshold: float) -> tuple[TurningPoints, bool]:
    """Add a value; return the state and whether a turning point was detected.

    After a turn to rising, ``low`` is the trough and ``high`` restarts; after a turn to falling, the reverse.
    """
    if value > turns.high:
        turns = replace(turns, high=value, high_s=seconds)
    if value < turns.low:
        turns = replace(turns, low=value, low_s=seconds)
    if turns.direction != RISING and value - turns.low > threshold:
        return replace(turns, direction=RISING, high=value, high_s=seconds, turned_s=seconds), True
    if turns.direction != FALLING and turns.high - value > threshold:
        return replace(turns, direction=FALLING, low=value, low_s=seconds, turned_s=seconds), True
    return turns, False


@dataclass(frozen=True, slots=True, kw_only=True)
class Bins:
    """State of the bins.

    Attributes
    ----------
    values
        Means of the last closed bins.
    open_s, total, count
        Start of the open bin, and the sum and number of its values.
    still_at, still_s
        Level at which the signal came to rest, and when; it has not left it since.
    """

    values: tuple[float, ...] = ()
    open_s: float = 0.0
    total: float = 0.0
    count: int = 0
    still_at: float = 0.0
    still_s: float = 0.0

    @property
    def level(self) -> float:
        """Mean over the last 0.6 s, or over fewer bins at the start."""
        return sum(self.values) / len(self.values)

    @property
    def is_level_known(self) -> bool:
        """Whether the level is the mean over the full 0.6 s."""
        return len(self.values) == LEVEL_BINS

    @property
    def short_level(self) -> float:
        """Mean over the last 0.3 s."""
        last = self.values[-SPEED_BINS:]
        return sum(last) / len(last) if last else math.nan

    @property
    def speed(self) -> float:
        """Speed of the signal over the last 0.3 s [mm/s]."""
        if len(self.values) <= SPEED_BINS:
            return 0.0
        return (self.values[-1] - self.values[-1 - SPEED_BINS]) / (SPEED_BINS * BIN_S)


def follow_bins(bins: Bins, seconds: float, value: float, amplitude: float) -> tuple[Bins, bool]:
    """Add a value; return the bins and whether one was closed. ``amplitude`` is that of a usual breath [mm]."""
    if bins.count == 0:
        return replace(bins, open_s=seconds, total=value, count=1, still_at=value, still_s=seconds), False
    if seconds - bins.open_s < BIN_S - 1e-6:
        return replace(bins, total=bins.total + value, count=bins.count + 1), False
    mean = bins.total / bins.count
    # With a slow camera a value lasts several bins: repeat it.
    lasted = min(max(1, round((seconds - bins.open_s) / BIN_S)), LEVEL_BINS)
    values = (*bins.values, *(mean,) * lasted)[-LEVEL_BINS:]
    closed = replace(bins, values=values, open_s=seconds, total=value, count=1)
    if abs(mean - bins.still_at) > max(MIN_STILL_MM, STILL_SHARE * amplitude):
        closed = replace(closed, still_at=mean, still_s=bins.open_s)
    return closed, True
