"""What a rig's service runs with, beside what every one does."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One sort of rig."""

    name: str
    settings: dict[str, object] = field(default_factory=dict)
    has_own_clock: bool = False


DEFAULT_PLAN = Plan(name="default")
WATCHED = Plan(name="watched", settings={"OPERATOR_TIMEOUT_S": 3.0})
"""The page of the person who armed is missed sooner than by default."""

OWN_CLOCK = Plan(name="own clock", settings={"LOGIN_IDLE_MIN": 120.0}, has_own_clock=True)
"""The wall clock of this process alone can be changed, the monotonic one is the machine's."""

ANY_HEIGHT = Plan(name="any height", settings={"MAX_HEIGHT_MM": 50.0})
"""A body raised as a whole leaves the window before it is too high."""
