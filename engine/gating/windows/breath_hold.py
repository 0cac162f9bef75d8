"""The breath-hold window: a level that is reached and held still, for a limited time."""

import enum
from dataclasses import dataclass
from functools import cached_property

from engine.core.bounds import check_number
from engine.core.breath import SignalChoice
from engine.core.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from engine.core.errors import InvalidValueError
from engine.core.gate_state import HoldReason
from engine.core.replacing import replace
from engine.core.sentences import say
from engine.core.signals import Ranges
from engine.gating.windows.amplitude import AmplitudeWindow
from engine.gating.windows.conditions import (
    ENDED_BY,
    ConditionState,
    HoldStage,
    WindowInput,
    WindowVerdict,
    interrupted,
    outside,
)
from engine.gating.windows.patient_breath import SignalNow

HOLD_BOUNDS: dict[str, tuple[float, float]] = {
    "settle_ms": (100.0, 10_000.0),
    "still": (0.05, 20.0),
    "max_drift": (0.1, 20.0),
    "timeout_s": (1.0, 120.0),
}
"""Lowest and highest value of each setting; ``still`` and ``max_drift`` are mm, or l of a volume."""

LEVEL_NOT_SET = say("the level of the breath hold is not set: hold a breath, and set the window there")


class HoldKind(enum.StrEnum):
    """Which end of the breath is held."""

    INSPIRATION = "inspiration"
    EXPIRATION = "expiration"


@dataclass(frozen=True, kw_only=True)
class BreathHoldWindow:
    """A breath hold: level reached, still, without drift, within its time limit.

    Attributes
    ----------
    level
        Window of the held signal.
    kind
        Inspiration or expiration; shown to the operator only.
    settle_ms
        Time inside and still before the hold counts [ms of the device's clock].
    still
        Largest range of the signal while it settles [mm or l].
    max_drift
        Largest distance from the settled level [mm or l]; beyond it the hold ends, until the patient has breathed.
    timeout_s
        Longest hold [s]: of one breath, through whatever windows; the least of theirs counts.
    is_level_set
        False until a level was taken from a breath that was held: ``level`` is in per cent then, and no range
        converts it.
    """

    level: AmplitudeWindow
    kind: HoldKind | str = HoldKind.INSPIRATION
    settle_ms: float = 1_000.0
    still: float = 1.0
    max_drift: float = 2.0
    timeout_s: float = 25.0
    is_level_set: bool = True

    def __post_init__(self) -> None:
        """Refuse numbers out of their bounds."""
        if self.kind not in set(HoldKind):
            raise InvalidValueError("kind", self.kind, f"one of {', '.join(HoldKind)}")
        object.__setattr__(self, "kind", HoldKind(self.kind))
        for name, (low, high) in HOLD_BOUNDS.items():
            check_number(name, getattr(self, name), low, high)
        if not self.is_level_set and not self.level.needs_ranges:
            raise InvalidValueError("is_level_set", value=False, bound="true for a level in mm or l")

    @cached_property
    def leaves(self) -> "tuple[BreathHoldWindow, ...]":
        """The window itself."""
        return (self,)

    @cached_property
    def choices(self) -> tuple[SignalChoice, ...]:
        """The signals it uses."""
        return self.level.choices

    @property
    def needs_ranges(self) -> bool:
        """Whether its level is in per cent, or not set."""
        return self.level.needs_ranges

    def resolved(self, ranges: Ranges) -> "BreathHoldWindow":
        """Convert per cent to mm or l; a level that is not set stays so."""
        return replace(self, level=self.level.resolved(ranges)) if self.is_level_set else self

    def shifted(self, choice: SignalChoice, by: float) -> "BreathHoldWindow":
        """Move the level by a baseline correction."""
        return replace(self, level=self.level.shifted(choice, by))

    def signal_now(self, frame_input: WindowInput) -> SignalNow:
        """Return what the patient's breath is judged by."""
        return self.level.signal_now(frame_input)

    def judge(self, frame_input: WindowInput, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Evaluate one frame and advance the stage of the hold."""
        state = states[0]
        if state.trail.is_away_long:
            state = ConditionState(holds=state.holds, trail=state.trail.begun(is_over=True))
        elif state.settled_at is not None and self.timeout_s < state.timeout_s:
            state = replace(state, timeout_s=self.timeout_s)
        inside = self.level.judge(frame_input, (replace(state, is_inside=state.stage is not HoldStage.AWAITED),))
        if not inside.is_inside:
            return outside(
                interrupted((state,))[0],
                HoldReason.BREATH_HOLD_AWAITED if inside.reason is HoldReason.OUTSIDE_WINDOW else inside.reason,
                inside.detail if self.is_level_set else LEVEL_NOT_SET,
            )
        if state.stage in ENDED_BY:
            return outside(state, ENDED_BY[state.stage], self._needs_a_breath())
        value = self.level.choice.value_in(frame_input.motion)
        ended = self._end(state, value, frame_input.timestamp_us)
        if ended is not None:
            return ended
        match state.stage:
            case HoldStage.HELD:
                return WindowVerdict(is_inside=True, states=(state,))
            case HoldStage.AWAITED:
                state = _begun(state, value, frame_input.timestamp_us)
        return self._settle(state, value, frame_input.timestamp_us)

    def _settle(self, state: ConditionState, value: float, now_us: int) -> WindowVerdict:
        lowest, highest = min(state.lowest, value), max(state.highest, value)
        if highest - lowest > self.still:
            return self._still_settling(_begun(state, value, now_us), say("the signal moves"))
        state = replace(state, lowest=lowest, highest=highest)
        if (now_us - state.since_us) * NS_PER_US < self.settle_ms * NS_PER_MS:
            return self._still_settling(
                state, say("still for {still_s:.1f} s", still_s=(now_us - state.since_us) / 1e6)
            )
        held = replace(state, stage=HoldStage.HELD, since_us=now_us)
        if held.settled_at is None:
            held = replace(
                held, settled_at=value, held_since_us=now_us, timeout_s=self.timeout_s, holds=state.holds + 1
            )
        return WindowVerdict(is_inside=True, states=(held,))

    def _still_settling(self, state: ConditionState, detail: str) -> WindowVerdict:
        return outside(
            state,
            HoldReason.BREATH_HOLD_SETTLING,
            say("{detail}; {settle_s:g} s needed", detail=detail, settle_s=self.settle_ms / 1000.0),
        )

    def _end(self, state: ConditionState, value: float, now_us: int) -> WindowVerdict | None:
        """Return the end of a hold that was still, by drift or by time; None while it continues or has not begun."""
        if state.settled_at is None:
            return None
        if not abs(value - state.settled_at) <= self.max_drift:
            ended = replace(state, stage=HoldStage.DRIFTED, since_us=now_us)
            detail = say(
                "{away:.1f} {unit} from the settled level", away=abs(value - state.settled_at), unit=self.level.unit
            )
            return outside(
                ended,
                HoldReason.BREATH_HOLD_DRIFTED,
                say("{detail}, {max_drift:g} allowed", detail=detail, max_drift=self.max_drift),
            )
        if (now_us - state.held_since_us) * NS_PER_US >= state.timeout_s * NS_PER_S:
            ended = replace(state, stage=HoldStage.OVER, since_us=now_us)
            return outside(
                ended, HoldReason.BREATH_HOLD_OVER, say("held for {timeout_s:g} s", timeout_s=state.timeout_s)
            )
        return None

    def _needs_a_breath(self) -> str:
        return say("the patient has to breathe before the next {kind} hold", kind=self.kind)


def _begun(state: ConditionState, value: float, now_us: int) -> ConditionState:
    """Return the state of a hold that begins to settle at this frame."""
    return replace(state, stage=HoldStage.SETTLING, since_us=now_us, lowest=value, highest=value)
