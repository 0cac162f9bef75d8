"""Conversion from the engine's monotonic nanoseconds to UTC."""

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeAnchor:
    """The UTC time and the monotonic time [ns] of one instant."""

    at: datetime
    at_ns: int

    @classmethod
    def now(cls) -> "TimeAnchor":
        """Read both clocks, one directly after the other."""
        return cls(at=datetime.now(UTC), at_ns=time.monotonic_ns())

    def utc(self, at_ns: int) -> datetime:
        """Convert a monotonic time [ns] to UTC, with microsecond resolution."""
        return self.at + timedelta(microseconds=(at_ns - self.at_ns) / 1000)
