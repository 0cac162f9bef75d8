"""Which signal a condition looks at: picked from a measurement, and refused where there can be none."""

import math

from engine.breath import GateSignal, SignalChoice
from engine.errors import InvalidValueError
from engine.frames import ROI_COLUMNS, ROI_ROWS, Motion


def signal_of(choice: SignalChoice, motion: Motion) -> float:
    """Pick a signal [mm, l of the volume]; NaN where the measurement has no such cell, point or region."""
    match choice.signal:
        case GateSignal.VOLUME:
            return float(motion.volume_l)
        case GateSignal.REGION:
            return _cell_mm(choice, motion)
        case GateSignal.POINT:
            return float(motion.points_mm[choice.index]) if choice.index < len(motion.points_mm) else math.nan
        case GateSignal.NAMED:
            return float(motion.named_mm[choice.index]) if choice.index < len(motion.named_mm) else math.nan
    return float(getattr(motion, f"{choice.signal}_mm"))


def _cell_mm(choice: SignalChoice, motion: Motion) -> float:
    rows, columns = motion.regions_mm.shape
    row, column = choice.row, choice.column
    if row is None or column is None or row >= rows or column >= columns:
        return math.nan
    return float(motion.regions_mm[row, column])


def check_choice(choice: SignalChoice) -> None:
    """Refuse a cell or point off the grid, and a place where the signal has none."""
    has_place = choice.signal in {GateSignal.REGION, GateSignal.POINT}
    for name, value, size in (("row", choice.row, ROI_ROWS), ("column", choice.column, ROI_COLUMNS)):
        if not has_place:
            if value is not None:
                raise InvalidValueError(name, value, "absent unless signal is region or point")
        elif isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < size:
            raise InvalidValueError(name, value, f"a whole number from 0 to {size - 1}")


def check_number(name: str, value: object, low: float, high: float) -> None:
    """Refuse what is no number, or beyond its bounds."""
    # Written so that NaN fails: every comparison with it is false.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InvalidValueError(name, value, f"a number from {low:g} to {high:g}")
