"""What is told of a line to those who only want to know, as a value and as the JSON of docs/beam.md."""

import enum
from dataclasses import dataclass, replace

from engine.clock import NS_PER_MS
from engine.permits import HoldReason

SCHEMA = "tidegate.beam/1"
GOOD_FOR_NS = 250 * NS_PER_MS
"""Without anything newer, what is said to be on is unknown after this: no lease and no settling last longer."""


class BeamState(enum.StrEnum):
    """What is known of the beam line."""

    ON = "on"
    OFF = "off"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class LineNews:
    """What the line was told and what it read back at ``at_ns``, host monotonic time [ns].

    ``reason`` is why it was last held, None while it is permitted.
    """

    beam: BeamState
    is_permitted: bool
    reason: HoldReason | None
    trouble: str | None
    at_ns: int

    def aged(self, now_ns: int) -> "LineNews":
        """Return what is still known at ``now_ns``: an old on is no on."""
        is_old = self.beam is BeamState.ON and now_ns - self.at_ns > GOOD_FOR_NS
        return replace(self, beam=BeamState.UNKNOWN) if is_old else self

    def is_same(self, other: "LineNews") -> bool:
        """Whether it says the same, at whatever time."""
        return replace(self, at_ns=other.at_ns) == other

    def document(self, *, kind: str, sequence: int, sent_at: str, now_ns: int) -> dict[str, object]:
        """Word it as the JSON that is sent; ``sent_at`` is RFC 3339 UTC, ``kind`` change or heartbeat."""
        return {
            "schema": SCHEMA,
            "kind": kind,
            "sequence": sequence,
            "sent_at": sent_at,
            "age_ms": round((now_ns - self.at_ns) / NS_PER_MS, 1),
            "beam": str(self.beam),
            "permitted": self.is_permitted,
            "reason": None if self.reason is None else str(self.reason),
            "trouble": self.trouble,
        }
