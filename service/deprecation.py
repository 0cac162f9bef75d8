"""What should not be used any more, and until when it stays: one table, empty while nothing is.

An entry makes the call's answers carry ``Deprecation`` (RFC 9745) and ``Sunset`` (RFC 8594), and shows in the
contract. What counts as breaking, and how long a deprecated call stays: docs/api.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from email.utils import format_datetime

SHORTEST = timedelta(days=365)
"""A call stays at least this long after it was said to go."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Deprecated:
    """Since when something should not be used, when it may go, and where it is said what to use instead."""

    since: date
    sunset: date
    instead: str = "docs/api.md"

    def __post_init__(self) -> None:
        if self.sunset - self.since < SHORTEST:
            msg = f"a deprecated call stays {SHORTEST.days} days at least: {self.since} to {self.sunset} is less"
            raise ValueError(msg)

    def headers(self) -> dict[str, str]:
        """Return the headers that say so."""
        return {
            "Deprecation": f"@{int(_midnight(self.since).timestamp())}",
            "Sunset": format_datetime(_midnight(self.sunset), usegmt=True),
        }


Call = tuple[str, str]
DEPRECATED: Mapping[Call, Deprecated] = {}
"""(method, path template) -> what is said of it."""


def _midnight(day: date) -> datetime:
    return datetime(day.year, day.month, day.day, tzinfo=UTC)
