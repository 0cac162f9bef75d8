"""The phase window: a breath between two phases."""

from dataclasses import dataclass

from engine.core.bounds import check_number
from engine.core.breath import WHOLE, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.gate_state import HoldReason
from engine.core.signals import Ranges, check_choice
from engine.gating.windows.conditions import ConditionState, WindowInput, WindowVerdict, outside


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseWindow:
    """Between two phases of the breath, 0 % at the end of inhale; through 0 where ``from_percent`` is the larger."""

    choice: SignalChoice = WHOLE
    from_percent: float
    to_percent: float
    min_confidence: float = 0.6

    def __post_init__(self) -> None:
        """Raise InvalidValueError for a number out of its bounds, or an empty or complete cycle."""
        check_choice(self.choice)
        check_number("from_percent", self.from_percent, 0.0, 100.0)
        check_number("to_percent", self.to_percent, 0.0, 100.0)
        check_number("min_confidence", self.min_confidence, 0.1, 1.0)
        if self.from_percent == self.to_percent or {self.from_percent, self.to_percent} == {0.0, 100.0}:
            raise InvalidValueError(
                "to_percent", self.to_percent, f"another phase than from_percent ({self.from_percent:g})"
            )

    @property
    def leaves(self) -> "tuple[PhaseWindow, ...]":
        """The window itself."""
        return (self,)

    @property
    def choices(self) -> tuple[SignalChoice, ...]:
        """The signals it uses."""
        return (self.choice,)

    @property
    def needs_ranges(self) -> bool:
        """Phases need no range."""
        return False

    def resolved(self, ranges: Ranges) -> "PhaseWindow":  # noqa: ARG002 - the interface of every window
        """Return itself: phases need no range."""
        return self

    def shifted(self, choice: SignalChoice, by: float) -> "PhaseWindow":  # noqa: ARG002 - the interface of every window
        """Return itself: a baseline does not move phases."""
        return self

    def contains(self, phase_percent: float) -> bool:
        """Whether a phase is inside; NaN never is."""
        if self.from_percent < self.to_percent:
            return self.from_percent <= phase_percent <= self.to_percent
        return phase_percent >= self.from_percent or phase_percent <= self.to_percent

    def judge(self, frame_input: WindowInput, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Evaluate one frame; an unknown phase, or one of low confidence, is outside."""
        state = states[0]
        breath = next((breath for breath in frame_input.breaths if breath.signal == self.choice), None)
        if breath is None or breath.phase_percent is None:
            note = "the phase of this signal is not computed" if breath is None else breath.note
            return outside(state, HoldReason.PHASE_UNKNOWN, note)
        if not breath.phase_confidence >= self.min_confidence:
            detail = f"confidence {breath.phase_confidence:.2f}, {self.min_confidence:.2f} needed"
            return outside(state, HoldReason.PHASE_UNKNOWN, detail)
        if not self.contains(breath.phase_percent):
            detail = f"{breath.phase_percent:.0f} % is not inside {self.from_percent:g} to {self.to_percent:g} %"
            return outside(state, HoldReason.OUTSIDE_WINDOW, detail, has_left=True)
        return WindowVerdict(is_inside=True, states=(state,))
