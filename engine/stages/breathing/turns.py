"""Where a signal turns: the ends of inhale and exhale, each known once the signal has left it by a threshold."""

from dataclasses import dataclass, replace

RISING, FALLING, UNKNOWN = 1, -1, 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Turns:
    """What is remembered: which way it goes, and the extreme since it last turned.

    Attributes
    ----------
    way
        ``RISING`` while a peak is looked for, ``FALLING`` while a trough is, ``UNKNOWN`` before the first turn.
    high, high_s, low, low_s
        Extremes since the last turn, and when.
    turned_s
        When the last turn was known.
    """

    way: int = UNKNOWN
    high: float = float("-inf")
    high_s: float = 0.0
    low: float = float("inf")
    low_s: float = 0.0
    turned_s: float = 0.0


def follow_turns(turns: Turns, seconds: float, value: float, threshold: float) -> tuple[Turns, bool]:
    """Take a value; return also whether it has just turned.

    A turn to rising makes ``low`` the trough that was left; ``high`` begins anew. A turn to falling likewise.
    """
    if value > turns.high:
        turns = replace(turns, high=value, high_s=seconds)
    if value < turns.low:
        turns = replace(turns, low=value, low_s=seconds)
    if turns.way != RISING and value - turns.low > threshold:
        return replace(turns, way=RISING, high=value, high_s=seconds, turned_s=seconds), True
    if turns.way != FALLING and turns.high - value > threshold:
        return replace(turns, way=FALLING, low=value, low_s=seconds, turned_s=seconds), True
    return turns, False
