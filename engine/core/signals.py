"""Choice of a signal: its value in a measurement, how much of it was seen, the check of its place, and its range.

The head direction is the side of the camera's picture at which the patient's head lies. The markers alone do not show
where the head is: with the wrong side, thorax and abdomen, and the patient's right and left, are exchanged. Only the
whole region and its volume stay what they are.

A range is what a signal was while the motion model was trained: per cent refer to it.
"""

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

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
SYMMETRIC_SIGNALS = frozenset({GateSignal.WHOLE, GateSignal.VOLUME})
"""Signals that are the same from whichever side the head lies."""
PERCENTILES = (5.0, 95.0)
"""Of the levels in the training: the end of exhale, and the end of inhale."""
LearnedLevels = Mapping[SignalChoice, FloatArray]
"""Levels against the present reference [mm, l of the volume] in training frames evenly spread over the training, shape
(n,), of the same frames for each signal. Signals whose levels are not known are absent."""


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


class HeadDirection(enum.StrEnum):
    """Side of the picture at which the patient's head lies."""

    TOP = "top"
    BOTTOM = "bottom"
    LEFT = "left"
    RIGHT = "right"

    @property
    def superior_px(self) -> tuple[float, float]:
        """Direction towards the head in the picture: x right, y down."""
        return _SUPERIOR_PX[self]

    @property
    def opposite(self) -> "HeadDirection":
        """The opposite side: the feet's."""
        return _OPPOSITE[self]


_SUPERIOR_PX = {
    HeadDirection.TOP: (0.0, -1.0),
    HeadDirection.BOTTOM: (0.0, 1.0),
    HeadDirection.LEFT: (-1.0, 0.0),
    HeadDirection.RIGHT: (1.0, 0.0),
}
_OPPOSITE = {
    HeadDirection.TOP: HeadDirection.BOTTOM,
    HeadDirection.BOTTOM: HeadDirection.TOP,
    HeadDirection.LEFT: HeadDirection.RIGHT,
    HeadDirection.RIGHT: HeadDirection.LEFT,
}


def depends_on_head(choice: SignalChoice) -> bool:
    """Whether a signal belongs to another part of the body where the head lies at another side."""
    return choice.signal not in SYMMETRIC_SIGNALS


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedRange:
    """End of exhale (``low``) and end of inhale (``high``) against the present reference [mm, l of the volume]."""

    low: float
    high: float

    def percent(self, level: float) -> float:
        """Return the place of a level in the range: 0 at the end of exhale, 100 at the end of inhale."""
        return 100.0 * (level - self.low) / (self.high - self.low)


Ranges = Mapping[SignalChoice, LearnedRange]
"""Signals whose range is not known are absent."""


def ranges_of(levels: LearnedLevels) -> Ranges:
    """Return the range of each signal from its levels; signals that did not move are left out."""
    found = {}
    for choice, values in levels.items():
        low, high = np.percentile(values, PERCENTILES)
        if high > low:
            found[choice] = LearnedRange(low=float(low), high=float(high))
    return found
