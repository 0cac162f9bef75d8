"""Conditions joined by and, or by or; and what a gate's window can be at all."""

import enum
from dataclasses import dataclass, replace

from engine.breath import SignalChoice
from engine.errors import InvalidValueError
from engine.windows.amplitude import AmplitudeWindow
from engine.windows.breath_hold import BreathHoldWindow
from engine.windows.conditions import ConditionState, Ranges, Sight, WindowVerdict
from engine.windows.phase import PhaseWindow

MAX_CONDITIONS = 4
Condition = AmplitudeWindow | BreathHoldWindow | PhaseWindow


class Join(enum.StrEnum):
    """How conditions are joined."""

    AND = "and"
    OR = "or"


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinedWindow:
    """Two to four conditions: inside when all are, or when any is."""

    conditions: tuple[Condition, ...]
    join: Join | str = Join.AND

    def __post_init__(self) -> None:
        """Refuse what joins nothing."""
        if self.join not in set(Join):
            raise InvalidValueError("join", self.join, f"one of {', '.join(Join)}")
        object.__setattr__(self, "join", Join(self.join))
        if not 2 <= len(self.conditions) <= MAX_CONDITIONS:
            raise InvalidValueError("conditions", len(self.conditions), f"2 to {MAX_CONDITIONS} conditions")

    @property
    def leaves(self) -> tuple[Condition, ...]:
        """The conditions."""
        return self.conditions

    @property
    def choices(self) -> tuple[SignalChoice, ...]:
        """The signals it looks at, each once, in order."""
        return tuple(dict.fromkeys(choice for condition in self.conditions for choice in condition.choices))

    @property
    def needs_ranges(self) -> bool:
        """Whether any condition is told in per cent."""
        return any(condition.needs_ranges for condition in self.conditions)

    def resolved(self, ranges: Ranges) -> "JoinedWindow":
        """Turn per cent into mm or l."""
        return replace(self, conditions=tuple(condition.resolved(ranges) for condition in self.conditions))

    def shifted(self, choice: SignalChoice, by: float) -> "JoinedWindow":
        """Move what looks at that signal by a baseline correction."""
        return replace(self, conditions=tuple(condition.shifted(choice, by) for condition in self.conditions))

    def judge(self, sight: Sight, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Judge one frame; the reason is that of the first condition that is not met."""
        verdicts = [condition.judge(sight, (state,)) for condition, state in zip(self.conditions, states, strict=True)]
        kept = tuple(verdict.states[0] for verdict in verdicts)
        unmet = next((verdict for verdict in verdicts if not verdict.is_inside), None)
        met = any(verdict.is_inside for verdict in verdicts)
        if unmet is None or (self.join is Join.OR and met):
            return WindowVerdict(is_inside=True, states=kept)
        return WindowVerdict(is_inside=False, states=kept, reason=unmet.reason, detail=unmet.detail)


GateWindow = AmplitudeWindow | BreathHoldWindow | PhaseWindow | JoinedWindow


def at_rest(window: GateWindow) -> tuple[ConditionState, ...]:
    """Return what a window remembers before its first frame."""
    return tuple(ConditionState() for _ in window.leaves)
