"""Choice of a signal: the check of its place, and its range.

The head direction is the side of the camera's picture at which the patient's head lies. The markers alone do not show
where the head is: with the wrong side, thorax and abdomen, and the patient's right and left, are exchanged. Only the
whole region and its volume stay what they are.

A range is what a signal was while the motion model was trained: per cent refer to it.
"""

import enum
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from engine.core.bounds import check_whole_number
from engine.core.breath import GateSignal, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray

SYMMETRIC_SIGNALS = frozenset({GateSignal.WHOLE, GateSignal.VOLUME})
"""Signals that are the same from whichever side the head lies."""
PERCENTILES = (5.0, 95.0)
"""Of the levels in the training: the end of exhale, and the end of inhale."""
LearnedLevels = Mapping[SignalChoice, FloatArray]
"""Levels against the present reference [mm, l of the volume] in training frames evenly spread over the training, shape
(n,), of the same frames for each signal. Signals whose levels are not known are absent."""


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
