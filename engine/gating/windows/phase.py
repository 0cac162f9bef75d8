"""The phase window: a breath between two phases.

Conditions joined by and, or by or.
"""

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from engine.core.bounds import check_number
from engine.core.breath import WHOLE, Breath, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.gate_state import HoldReason
from engine.core.replacing import replace
from engine.core.sentences import say
from engine.core.signals import Ranges, check_choice
from engine.gating.windows.amplitude import AmplitudeWindow
from engine.gating.windows.breath_hold import BreathHoldWindow
from engine.gating.windows.conditions import ConditionState, HoldStage, WindowInput, WindowVerdict, outside
from engine.gating.windows.patient_breath import SignalNow

MAX_CONDITIONS = 4


@dataclass(frozen=True, kw_only=True)
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

    @cached_property
    def leaves(self) -> "tuple[PhaseWindow, ...]":
        """The window itself."""
        return (self,)

    @cached_property
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

    def signal_now(self, frame_input: WindowInput) -> SignalNow:
        """Return what the patient's breath is judged by: a phase that is not known well is not outside."""
        breath = self._breath(frame_input)
        phase = None if breath is None or not breath.phase_confidence >= self.min_confidence else breath.phase_percent
        return SignalNow(
            value=self.choice.value_in(frame_input.motion),
            at_us=frame_input.timestamp_us,
            edges=None,
            is_out=phase is not None and not self.contains(phase),
            breath=frame_input.depth_of(self.choice),
            per_mm=self.choice.per_mm,
        )

    def _breath(self, frame_input: WindowInput) -> Breath | None:
        return next((breath for breath in frame_input.breaths if breath.signal == self.choice), None)

    def judge(self, frame_input: WindowInput, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Evaluate one frame; an unknown phase, or one of low confidence, is outside."""
        state = states[0]
        breath = self._breath(frame_input)
        if breath is None or breath.phase_percent is None:
            note = say("the phase of this signal is not computed") if breath is None else breath.note
            return outside(state, HoldReason.PHASE_UNKNOWN, note)
        if not breath.phase_confidence >= self.min_confidence:
            detail = say(
                "confidence {phase_confidence:.2f}, {min_confidence:.2f} needed",
                phase_confidence=breath.phase_confidence,
                min_confidence=self.min_confidence,
            )
            return outside(state, HoldReason.PHASE_UNKNOWN, detail)
        if not self.contains(breath.phase_percent):
            detail = say(
                "{phase_percent:.0f} % is not inside {from_percent:g} to {to_percent:g} %",
                phase_percent=breath.phase_percent,
                from_percent=self.from_percent,
                to_percent=self.to_percent,
            )
            return outside(state, HoldReason.OUTSIDE_WINDOW, detail)
        return WindowVerdict(is_inside=True, states=(state,))


Condition = AmplitudeWindow | BreathHoldWindow | PhaseWindow


class Join(enum.StrEnum):
    """How conditions are joined."""

    AND = "and"
    OR = "or"


@dataclass(frozen=True, kw_only=True)
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

    @cached_property
    def leaves(self) -> tuple[Condition, ...]:
        """The conditions."""
        return self.conditions

    @cached_property
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
        return WindowVerdict(
            is_inside=False,
            states=states_now,
            reason=unmet.reason,
            detail=unmet.detail,
        )


GateWindow = AmplitudeWindow | BreathHoldWindow | PhaseWindow | JoinedWindow


def is_held(window: GateWindow, states: tuple[ConditionState, ...]) -> bool:
    """Whether a breath hold of the window is held now: what was observed, whatever the window is called."""
    for leaf, state in zip(window.leaves, states, strict=True):
        if state.stage is HoldStage.HELD and isinstance(leaf, BreathHoldWindow):
            return True
    return False


def begun(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return the states at the beginning of a new stay."""
    return tuple(replace(state, trail=state.trail.begun()) for state in states)


def followed(
    signals: Sequence[SignalNow], states: tuple[ConditionState, ...], max_gap_ms: float
) -> tuple[ConditionState, ...]:
    """Return the states with the signal of each condition followed to this frame."""
    after: tuple[ConditionState, ...] = ()
    for signal, state in zip(signals, states, strict=True):
        after += (replace(state, trail=state.trail.followed(signal, max_gap_ms)),)
    return after


def permitted(
    signals: Sequence[SignalNow], states: tuple[ConditionState, ...], *, on_ns: int, is_on: bool
) -> tuple[ConditionState, ...]:
    """Return the states after the decision on a frame: with the beam on, or a breath held, that is the place.

    The same tuple where nothing has changed.
    """
    after = states
    for at, (signal, state) in enumerate(zip(signals, states, strict=True)):
        if is_on or state.stage is HoldStage.HELD:
            trail = state.trail.permitted(signal, on_ns)
            if trail is not state.trail:
                after = (*after[:at], replace(state, trail=trail), *after[at + 1 :])
    return after


def breathed_from_ns(window: GateWindow, states: tuple[ConditionState, ...], on_ns: int) -> int | None:
    """Return the beam-on time of the old stay at which the new one starts [ns]; None if the patient has not breathed.

    Where all conditions are needed, the breath of one of them ends a stay; where any permits the beam, of all.
    """
    ended: list[int] = []
    for state in states:
        from_ns = state.trail.breathed_from_ns(on_ns)
        if from_ns is not None:
            ended.append(from_ns)
    if isinstance(window, JoinedWindow) and window.join is Join.OR:
        return min(ended) if len(ended) == len(states) else None
    return max(ended) if ended else None


def initial_states(window: GateWindow) -> tuple[ConditionState, ...]:
    """Return the states of a window's conditions before its first frame."""
    return tuple(ConditionState() for _ in window.leaves)
