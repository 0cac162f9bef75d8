"""The groups and scopes of the identity provider in the tests."""

from datetime import UTC, datetime

GROUPS = "radiotherapy=therapist,physics=physicist,it=admin,physics=viewer"

SCOPES = "tidegate.read=sessions.read,tidegate.run=sessions.run"


def utc_now() -> datetime:
    return datetime.now(UTC)
