"""Counters of the live stream for monitoring."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

CloseReason = Literal["gone", "stalled", "not_logged_in", "chatty", "full", "failed", "leaving"]
"""Why a client's connection ended; ``full``: it was refused. Values are sent to clients and used as metric labels."""
CLOSE_REASONS: tuple[CloseReason, ...] = ("gone", "stalled", "not_logged_in", "chatty", "full", "failed", "leaving")


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamReading:
    """Connected clients, and totals since the start.

    Attributes
    ----------
    clients
        Connected clients by transport, form and encoding.
    sent
        Messages sent to all clients.
    skipped
        Samples dropped because a client was too slow.
    closed
        Ended connections by reason.
    encoded
        Encoded messages: one per shape, shared by all clients of that shape.
    """

    clients: Mapping[tuple[str, str, str], int]
    sent: int
    skipped: int
    closed: Mapping[str, int]
    encoded: int

    @property
    def refused(self) -> int:
        """Clients refused because the stream was full."""
        return self.closed.get("full", 0)


@dataclass(slots=True)
class StreamCounts:
    """Counters; used by the event loop only."""

    sent: int = 0
    skipped: int = 0
    closed: Counter[CloseReason] = field(default_factory=Counter)
