"""Choice of a signal: its value in a measurement, and the check of its place."""

import math

from engine.core.bounds import check_whole_number
from engine.core.breath import GateSignal, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, Motion


def signal_of(choice: SignalChoice, motion: Motion) -> float:
    """Return a signal [mm, l of the volume]; NaN where the measurement has no such cell, point or region."""
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
    """Raise InvalidValueError for a cell or point off the grid, or a place for a signal without one."""
    has_place = choice.signal in {GateSignal.REGION, GateSignal.POINT}
    for name, value, size in (("row", choice.row, ROI_ROWS), ("column", choice.column, ROI_COLUMNS)):
        if not has_place:
            if value is not None:
                raise InvalidValueError(name, value, "absent unless signal is region or point")
        else:
            check_whole_number(name, value, 0, size - 1)
