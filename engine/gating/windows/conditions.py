"""Input, state and verdict of every kind of window."""

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

from engine.core.breath import Breath, SignalChoice
from engine.core.frames import Motion
from engine.core.gate_state import HoldReason
from engine.core.replacing import replace
from engine.core.signals import Ranges
from engine.gating.windows.patient_breath import SignalTrail

NO_TRAIL = SignalTrail()


class HoldStage(enum.StrEnum):
    """Stage of a breath hold."""

    AWAITED = "awaited"
    SETTLING = "settling"
    HELD = "held"
    DRIFTED = "drifted"
    OVER = "over"


class BreathDepth(NamedTuple):
    """Depth of the learned breath in a signal [mm, l of the volume]."""

    choice: SignalChoice
    depth: float


def breath_depths(ranges: Ranges) -> tuple[BreathDepth, ...]:
    """Return the depth of the learned breath in each signal whose range is known."""
    return tuple(BreathDepth(choice, learned.high - learned.low) for choice, learned in ranges.items())


class WindowInput(NamedTuple):
    """The part of a checked frame that a window uses, and the learned breath that it is compared with."""

    motion: Motion
    breaths: tuple[Breath, ...]
    timestamp_us: int
    depths: tuple[BreathDepth, ...] = ()

    def depth_of(self, choice: SignalChoice) -> float | None:
        """Return the depth of the learned breath in a signal; None where it is not known."""
        for one in self.depths:
            if one.choice == choice:
                return one.depth
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionState:
    """State of one condition from frame to frame.

    Attributes
    ----------
    is_inside
        Of an amplitude window: whether the last checked frame was inside, which decides what its hysteresis asks.
    stage, since_us
        Of a breath hold: its stage, and since when by the device's clock [us].
    lowest, highest
        Of a breath hold: extremes of the signal while it settles [mm or l].
    settled_at, held_since_us
        Of a breath hold: the level at which it was still, and when [us]; unchanged by unusable frames, because the
        patient has not breathed meanwhile. None before.
    timeout_s
        Of a breath hold: the least time that any window in force since then has allowed it [s].
    holds
        Number of breath holds so far that became still.
    trail
        Where its signal was with the beam on, and whether the patient has breathed since.
    """

    is_inside: bool = False
    stage: HoldStage = HoldStage.AWAITED
    since_us: int = 0
    lowest: float = math.inf
    highest: float = -math.inf
    settled_at: float | None = None
    held_since_us: int = 0
    timeout_s: float = math.inf
    holds: int = 0
    trail: SignalTrail = NO_TRAIL


class WindowVerdict(NamedTuple):
    """Whether the frame is inside, the new states, and the reason if it is not."""

    is_inside: bool
    states: tuple[ConditionState, ...]
    reason: HoldReason | None = None
    detail: str = ""


ENDED_BY = {HoldStage.DRIFTED: HoldReason.BREATH_HOLD_DRIFTED, HoldStage.OVER: HoldReason.BREATH_HOLD_OVER}


def interrupted(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return the states after an unusable frame: every condition has to be entered again.

    A breath hold keeps its count, its end, and its level and time if it was still: a patient who is not visible for a
    moment has not breathed.
    """
    return tuple(
        replace(state, is_inside=False)
        if state.stage in ENDED_BY
        else ConditionState(
            settled_at=state.settled_at,
            held_since_us=state.held_since_us,
            timeout_s=state.timeout_s,
            holds=state.holds,
            trail=state.trail,
        )
        for state in states
    )


def left(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return the states while the gate as a whole is outside: every condition has to be entered again."""
    return tuple(replace(state, is_inside=False) for state in states)


def armed_again(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return the states at an arming: as after an unusable frame, and holds are counted from here.

    Arming is no breath: a hold that has ended stays ended, and one that is held keeps its level and time.
    """
    return tuple(
        replace(state, holds=int(state.settled_at is not None and state.stage not in ENDED_BY))
        for state in interrupted(states)
    )


def rescaled(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return the states where motion counts from another reference, or is measured with another model."""
    return tuple(replace(state, trail=state.trail.rescaled()) for state in states)


def outside(state: ConditionState, reason: HoldReason | None, detail: str) -> WindowVerdict:
    """Return a verdict outside, with its reason."""
    return WindowVerdict(
        is_inside=False,
        states=(replace(state, is_inside=False),),
        reason=reason,
        detail=detail,
    )
