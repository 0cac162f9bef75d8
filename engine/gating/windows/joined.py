"""Conditions joined by and, or by or."""

import enum
from dataclasses import dataclass

from engine.core.breath import SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.replacing import replace
from engine.core.signals import Ranges
from engine.gating.windows.amplitude import AmplitudeWindow
from engine.gating.windows.breath_hold import BreathHoldWindow
from engine.gating.windows.conditions import ConditionState, HoldStage, WindowInput, WindowVerdict
from engine.gating.windows.phase import PhaseWindow

MAX_CONDITIONS = 4
Condition = AmplitudeWindow | BreathHoldWindow | PhaseWindow


class Join(enum.StrEnum):
    """How conditions are joined."""

    AND = "and"
    OR = "or"


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinedWindow:
    """Two to four conditions: inside where all are (and), or any is (or)."""

    conditions: tuple[Condition, ...]
    join: Join | str = Join.AND

    def __post_init__(self) -> None:
        """Raise InvalidValueError for an unknown join or a wrong number of conditions."""
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
        """The signals it uses, each once, in order."""
        return tuple(dict.fromkeys(choice for condition in self.conditions for choice in condition.choices))

    @property
    def needs_ranges(self) -> bool:
        """Whether any condition is in per cent."""
        return any(condition.needs_ranges for condition in self.conditions)

    def resolved(self, ranges: Ranges) -> "JoinedWindow":
        """Convert per cent to mm or l."""
        return replace(self, conditions=tuple(condition.resolved(ranges) for condition in self.conditions))

    def shifted(self, choice: SignalChoice, by: float) -> "JoinedWindow":
        """Move the conditions on that signal by a baseline correction [mm or l]."""
        return replace(self, conditions=tuple(condition.shifted(choice, by) for condition in self.conditions))

    def judge(self, frame_input: WindowInput, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Evaluate one frame; the reason is that of the first condition that is not met."""
        verdicts = [
            condition.judge(frame_input, (state,)) for condition, state in zip(self.conditions, states, strict=True)
        ]
        states_now = tuple(verdict.states[0] for verdict in verdicts)
        unmet = next((verdict for verdict in verdicts if not verdict.is_inside), None)
        met = any(verdict.is_inside for verdict in verdicts)
        if unmet is None or (self.join is Join.OR and met):
            return WindowVerdict(is_inside=True, states=states_now)
        leavers = any if self.join is Join.AND else all
        return WindowVerdict(
            is_inside=False,
            states=states_now,
            reason=unmet.reason,
            detail=unmet.detail,
            has_left=leavers(verdict.has_left for verdict in verdicts),
        )


GateWindow = AmplitudeWindow | BreathHoldWindow | PhaseWindow | JoinedWindow


def is_held(window: GateWindow, states: tuple[ConditionState, ...]) -> bool:
    """Whether a breath hold of the window is held now: what was observed, whatever the window is called."""
    return any(
        isinstance(leaf, BreathHoldWindow) and state.stage is HoldStage.HELD
        for leaf, state in zip(window.leaves, states, strict=True)
    )


def initial_states(window: GateWindow) -> tuple[ConditionState, ...]:
    """Return the states of a window's conditions before its first frame."""
    return tuple(ConditionState() for _ in window.leaves)
