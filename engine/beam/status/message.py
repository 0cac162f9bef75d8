"""Status of a beam line for subscribers, as a value and as the JSON of docs/3-operate/beam.md."""

import enum
from dataclasses import dataclass, replace

from engine.core.clock import NS_PER_MS
from engine.core.gate_state import HoldReason

SCHEMA = "tidegate.beam/1"
GOOD_FOR_NS = 250 * NS_PER_MS
"""A reading of on becomes unknown after this time without a newer one: no lease and no settling lasts longer."""


class BeamState(enum.StrEnum):
    """State of the beam line as last read back."""

    ON = "on"
    OFF = "off"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class LineStatus:
    """Command and read-back of the line at ``at_ns``, host monotonic time [ns].

    ``reason`` is why it was last held, None while it is permitted.
    """

    beam: BeamState
    is_permitted: bool
    reason: HoldReason | None
    trouble: str | None
    at_ns: int

    def aged(self, now_ns: int) -> "LineStatus":
        """Return the status as of ``now_ns``: a reading of on that is too old becomes unknown."""
        is_old = self.beam is BeamState.ON and now_ns - self.at_ns > GOOD_FOR_NS
        return replace(self, beam=BeamState.UNKNOWN) if is_old else self

    def is_same(self, other: "LineStatus") -> bool:
        """Whether everything but the time is equal."""
        return replace(self, at_ns=other.at_ns) == other

    def document(self, *, kind: str, sequence: int, sent_at: str, now_ns: int) -> dict[str, object]:
        """Return the JSON document to send; ``sent_at`` is RFC 3339 UTC, ``kind`` change or heartbeat."""
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
