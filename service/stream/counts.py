"""What monitoring may know of the stream: how many watch, how much was sent, left out, cut off."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Why = Literal["gone", "stalled", "not_logged_in", "chatty", "full", "failed", "leaving"]
"""Why a client is one no more; ``full`` never was one."""
WHYS: tuple[Why, ...] = ("gone", "stalled", "not_logged_in", "chatty", "full", "failed", "leaving")


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamReading:
    """How it stands, and how much there was since the start.

    Attributes
    ----------
    clients
        Now, by transport, form and encoding.
    sent
        Messages, to all clients together.
    skipped
        Samples left out because a client took too long.
    closed
        Clients that are none any more, by why.
    encoded
        Messages written: however many watch, one for each form that somebody wants.
    """

    clients: Mapping[tuple[str, str, str], int]
    sent: int
    skipped: int
    closed: Mapping[str, int]
    encoded: int

    @property
    def refused(self) -> int:
        """Clients for whom there was no place."""
        return self.closed.get("full", 0)


@dataclass(slots=True)
class StreamCounts:
    """Counters, for the event loop alone."""

    sent: int = 0
    skipped: int = 0
    closed: Counter[Why] = field(default_factory=Counter)
