"""One moment on both clocks: the engine counts monotonic nanoseconds, people read UTC."""

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeAnchor:
    """One moment on both clocks, to write monotonic times as UTC."""

    at: datetime
    at_ns: int

    @classmethod
    def now(cls) -> "TimeAnchor":
        """Read both clocks."""
        return cls(at=datetime.now(UTC), at_ns=time.monotonic_ns())

    def utc(self, at_ns: int) -> datetime:
        """Convert host monotonic time [ns]."""
        return self.at + timedelta(microseconds=(at_ns - self.at_ns) / 1000)
