"""The side of the camera's picture at which the patient's head lies, and which signals depend on it.

The markers alone do not show where the head is: with the wrong side, thorax and abdomen, and the patient's right and
left, are exchanged. Only the whole region and its volume stay what they are.
"""

import enum

from engine.core.breath import GateSignal, SignalChoice


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
SYMMETRIC_SIGNALS = frozenset({GateSignal.WHOLE, GateSignal.VOLUME})
"""Signals that are the same from whichever side the head lies."""


def depends_on_head(choice: SignalChoice) -> bool:
    """Whether a signal belongs to another part of the body where the head lies at another side."""
    return choice.signal not in SYMMETRIC_SIGNALS
