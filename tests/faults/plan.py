"""What a rig's service runs with, beside what every one does."""

from dataclasses import dataclass, field
from pathlib import Path

FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1")
CLOCK_FILE = "wall-clock"
CLOCK_LOOK_S = 1.0
"""The process looks so often whether its wall clock was changed: reading the file at every call would slow it down."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One sort of rig; ``{folder}`` in the environment is the rig's own."""

    name: str
    settings: dict[str, object] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)


ANYBODY = Plan(name="default")
WATCHED = Plan(name="watched", settings={"OPERATOR_TIMEOUT_S": 3.0})
"""The page of whoever armed has to be heard of."""

OWN_WALL_CLOCK = Plan(
    name="own wall clock",
    environment={
        "LD_PRELOAD": str(FAKETIME),
        "FAKETIME_TIMESTAMP_FILE": f"{{folder}}/{CLOCK_FILE}",
        "FAKETIME_CACHE_DURATION": f"{CLOCK_LOOK_S:g}",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    },
)
"""The wall clock of this process alone can be changed, the monotonic one is the machine's."""
