"""Detects the ends of inhale and exhale: an extreme is a turning point once the signal has left it by a threshold."""

from dataclasses import dataclass

from engine.core.replacing import replace

RISING, FALLING, UNKNOWN = 1, -1, 0


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
