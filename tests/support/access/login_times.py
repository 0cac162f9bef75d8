"""How long a login lasts in the tests of access."""

from datetime import timedelta

IDLE = timedelta(minutes=30)

LASTS = timedelta(hours=12)
