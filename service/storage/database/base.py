"""Shared by all tables: the declarative base, and the column type for UTC times.

Conversion from the engine's monotonic nanoseconds to UTC.
"""

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import BigInteger, Dialect, Integer, String, TypeDecorator
from sqlalchemy.orm import DeclarativeBase

BigInt = BigInteger().with_variant(Integer(), "sqlite")
"""64-bit integer for counters, nanoseconds and bytes; SQLite integers have 64 bits anyway."""


class Base(DeclarativeBase):
    """Declarative base of all tables."""


def utc_text(at: datetime) -> str:
    """Format an aware time as RFC 3339 UTC with microseconds, so that text order is time order."""
    return at.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


class UtcTime(TypeDecorator[datetime]):
    """Column type of an aware time, stored as UTC text, since SQLite has no time zones."""

    impl = String(27)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> str | None:  # noqa: ARG002 - signature of the base
        """Return UTC text; raise ValueError for a naive time."""
        if value is None:
            return None
        if value.tzinfo is None:
            msg = f"a naive time cannot be stored: {value}"
            raise ValueError(msg)
        return utc_text(value)

    def process_result_value(self, value: str | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002 - signature of the base
        """Return the aware time; None for NULL."""
        return None if value is None else datetime.fromisoformat(value)


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
