"""What all tables share: the declarative base, and times as sortable UTC text."""

from datetime import UTC, datetime

from sqlalchemy import BigInteger, Dialect, Integer, String, TypeDecorator
from sqlalchemy.orm import DeclarativeBase

BigInt = BigInteger().with_variant(Integer(), "sqlite")
"""For what may grow beyond 31 bits: counters that never end, ns, us, bytes. SQLite's integers are that wide anyway."""


class Base(DeclarativeBase):
    """Base of all tables."""


def utc_text(at: datetime) -> str:
    """Write an aware time as RFC 3339 UTC with microseconds: text that sorts as time does."""
    return at.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


class UtcTime(TypeDecorator[datetime]):
    """An aware UTC time; SQLite itself would drop the zone."""

    impl = String(27)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> str | None:  # noqa: ARG002 - signature of the base
        """Refuse naive times; store UTC text."""
        if value is None:
            return None
        if value.tzinfo is None:
            msg = f"a naive time cannot be stored: {value}"
            raise ValueError(msg)
        return utc_text(value)

    def process_result_value(self, value: str | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002 - signature of the base
        """Read back as an aware time."""
        return None if value is None else datetime.fromisoformat(value)
