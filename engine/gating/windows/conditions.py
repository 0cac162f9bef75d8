"""Input, state and verdict of every kind of window."""

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

from engine.core.breath import Breath
from engine.core.frames import Motion
from engine.core.gate_state import HoldReason
from engine.core.replacing import replace


class HoldStage(enum.StrEnum):
    """Stage of a breath hold."""

    AWAITED = "awaited"
    SETTLING = "settling"
    HELD = "held"
    DRIFTED = "drifted"
    OVER = "over"


class WindowInput(NamedTuple):
    """The part of a checked frame that a window uses."""

    motion: Motion
    breaths: tuple[Breath, ...]
    timestamp_us: int


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
    holds
        Number of breath holds so far that became still.
    """

    is_inside: bool = False
    stage: HoldStage = HoldStage.AWAITED
    since_us: int = 0
    lowest: float = math.inf
    highest: float = -math.inf
    settled_at: float | None = None
    held_since_us: int = 0
    holds: int = 0


class WindowVerdict(NamedTuple):
    """Whether the frame is inside, the new states, and the reason if it is not.

    ``has_left``: the value was measured beyond an edge itself, so the patient has breathed. A value between an edge and
    the hysteresis, or one that is not known, is outside and has not left.
    """

    is_inside: bool
    states: tuple[ConditionState, ...]
    reason: HoldReason | None = None
    detail: str = ""
    has_left: bool = False


ENDED_BY = {HoldStage.DRIFTED: HoldReason.BREATH_HOLD_DRIFTED, HoldStage.OVER: HoldReason.BREATH_HOLD_OVER}


def interrupted(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return the states after an unusable frame: every condition has to be entered again.

    A breath hold keeps its count, its end, and its level and time if it was still: a patient who is not visible for a
    moment has not breathed.
    """
    return tuple(
        replace(state, is_inside=False)
        if state.stage in ENDED_BY
        else ConditionState(settled_at=state.settled_at, held_since_us=state.held_since_us, holds=state.holds)
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


def outside(state: ConditionState, reason: HoldReason | None, detail: str, *, has_left: bool = False) -> WindowVerdict:
    """Return a verdict outside, with its reason."""
    return WindowVerdict(
        is_inside=False,
        states=(replace(state, is_inside=False),),
        reason=reason,
        detail=detail,
        has_left=has_left,
    )
