"""What the drill of the heartbeat needs: a line whose exchanges can be stopped, and another way to see its contact.

A killed process leaves its last permit and its last heartbeat in the receiver. Only the receiver can drop the permit
then, and the line's own read-back shows nothing any more. So the drill stops the exchanges and looks elsewhere.
"""

from dataclasses import dataclass
from typing import Protocol

RECEIVER_DROP_MS = 200.0
"""Longest time from the last heartbeat until a receiver has opened its contact (docs/3-operate/beam.md)."""

NOT_VERIFIABLE = "not verifiable: no second input configured"


LEAST_REPEATS = 3
"""Heartbeats that a receiver must have answered before its contact is said to stay open with them."""


class StandingLine(Protocol):
    """A line that can stop its exchanges with the permit on, for the drill alone, never in a session.

    A standstill ends with the next hold from any thread, and by itself within a second.
    """

    def stand_still(self) -> None:
        """Send nothing more after the exchange in progress: permit and heartbeat stay as they are."""

    @property
    def still_since_ns(self) -> int | None:
        """Earliest time of the last heartbeat [ns]; None unless the line stands still with the permit on."""

    def repeat_permit(self) -> None:
        """Send heartbeats again, and with them the permit of before without withdrawing it, as a delayed write would.

        Ignored unless the line stands still.
        """

    @property
    def repeats(self) -> int:
        """How often the permit of before was sent again and answered; 0 unless the line stands still."""


class LookingLine(Protocol):
    """A line that reads its contact by its own connection, also while it stands still."""

    def reads_closed(self) -> bool:
        """Return the newest reading of the contact."""


class SecondInput(Protocol):
    """A way to see the receiver's contact that sends neither permit nor heartbeat; used by one thread."""

    def open(self) -> None:
        """Connect; raise BeamLineError where that fails."""

    def is_closed(self) -> bool:
        """Return whether the contact is closed; raise BeamLineError where it does not answer."""

    def close(self) -> None:
        """Disconnect; safe to call twice."""


class OwnInput:
    """`SecondInput` over the line's own connection, which only it may use: a serial port has one master."""

    def __init__(self, line: LookingLine) -> None:
        self._line = line

    def open(self) -> None:
        """Do nothing: the line is open."""

    def is_closed(self) -> bool:
        """Return the newest reading of the contact."""
        return self._line.reads_closed()

    def close(self) -> None:
        """Do nothing: the line stays open."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrilledReceiver:
    """One receiver of a beam line.

    Attributes
    ----------
    name
        Kind of the line that leads to it, for messages.
    second_input
        Another way to see its contact; None where the site has configured none.
    """

    name: str
    line: StandingLine
    second_input: SecondInput | None
