"""Choice of a signal: its value in a measurement, how much of it was seen, and the check of its place."""

import math
from operator import attrgetter

from engine.core.bounds import check_whole_number
from engine.core.breath import GateSignal, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray, Motion, SeenShares

_WIDE_MM: "dict[str, attrgetter[float]]" = {
    GateSignal.WHOLE: attrgetter("whole_mm"),
    GateSignal.THORAX: attrgetter("thorax_mm"),
    GateSignal.ABDOMEN: attrgetter("abdomen_mm"),
}
_WIDE_SEEN: "dict[str, attrgetter[float]]" = {
    GateSignal.WHOLE: attrgetter("whole"),
    GateSignal.THORAX: attrgetter("thorax"),
    GateSignal.ABDOMEN: attrgetter("abdomen"),
}


def signal_of(choice: SignalChoice, motion: Motion) -> float:
    """Return a signal [mm, l of the volume]; NaN where the measurement has no such cell, point or region."""
    match choice.signal:
        case GateSignal.VOLUME:
            return float(motion.volume_l)
        case GateSignal.REGION:
            return _at_cell(choice, motion.regions_mm)
        case GateSignal.POINT:
            return float(motion.points_mm[choice.index]) if choice.index < len(motion.points_mm) else math.nan
        case GateSignal.NAMED:
            return float(motion.named_mm[choice.index]) if choice.index < len(motion.named_mm) else math.nan
    return float(_WIDE_MM[choice.signal](motion))


def is_wide(choice: SignalChoice) -> bool:
    """Whether a signal is of a large part of the region: the whole, a half, or the volume."""
    return choice.signal not in {GateSignal.REGION, GateSignal.POINT, GateSignal.NAMED}


def seen_share_of(choice: SignalChoice, seen: SeenShares) -> float:
    """Return the share of a signal's area that was seen, 0 to 1; NaN where it is unknown."""
    match choice.signal:
        case GateSignal.VOLUME:
            return seen.whole
        case GateSignal.REGION:
            return _at_cell(choice, seen.cells)
        case GateSignal.POINT:
            return float(seen.points[choice.index]) if choice.index < len(seen.points) else math.nan
        case GateSignal.NAMED:
            return float(seen.named[choice.index]) if choice.index < len(seen.named) else math.nan
    return float(_WIDE_SEEN[choice.signal](seen))


def _at_cell(choice: SignalChoice, cells: FloatArray) -> float:
    rows, columns = cells.shape
    row, column = choice.row, choice.column
    if row is None or column is None or row >= rows or column >= columns:
        return math.nan
    return float(cells[row, column])


def check_choice(choice: SignalChoice) -> None:
    """Raise InvalidValueError for a cell or point off the grid, or a place for a signal without one."""
    has_place = choice.signal in {GateSignal.REGION, GateSignal.POINT}
    for name, value, size in (("row", choice.row, ROI_ROWS), ("column", choice.column, ROI_COLUMNS)):
        if not has_place:
            if value is not None:
                raise InvalidValueError(name, value, "absent unless signal is region or point")
        else:
            check_whole_number(name, value, 0, size - 1)
