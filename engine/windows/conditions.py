"""What every kind of window shares: what it is shown of a frame, what it remembers, and what it says."""

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from engine.breath import Breath, SignalChoice
from engine.frames import Motion
from engine.permits import HoldReason


class HoldStage(enum.StrEnum):
    """Where a breath hold stands."""

    AWAITED = "awaited"
    SETTLING = "settling"
    HELD = "held"
    DRIFTED = "drifted"
    OVER = "over"


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedRange:
    """The range a signal had while the model was learned, against the present reference [mm or l]."""

    low: float
    high: float


Ranges = Mapping[SignalChoice, LearnedRange]


class Sight(NamedTuple):
    """What a window is shown of one trusted frame."""

    motion: Motion
    breaths: tuple[Breath, ...]
    timestamp_us: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionState:
    """What one condition remembers from frame to frame.

    Attributes
    ----------
    is_inside
        Whether the last trusted frame was inside.
    stage, since_us
        Of a breath hold: where it stands, and since when by the device's clock.
    lowest, highest
        Of a breath hold: extremes of the signal while it settles.
    settled_at, held_since_us
        Of a breath hold: the level at which it was found still, and when; kept over frames that could not be judged,
        for the patient has not breathed meanwhile. None before it was.
    holds
        Breath holds counted so far: those that came to be still.
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
    """Whether the frame is inside, and if not why; with what to remember."""

    is_inside: bool
    states: tuple[ConditionState, ...]
    reason: HoldReason | None = None
    detail: str = ""


ENDED_BY = {HoldStage.DRIFTED: HoldReason.BREATH_HOLD_DRIFTED, HoldStage.OVER: HoldReason.BREATH_HOLD_OVER}


def interrupted(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return what is remembered after a frame that could not be judged: what has to be inside enters anew.

    Of a breath hold it is kept how many there were, that one has ended and a breath is due, and, of one that was found
    still, where and since when: whoever is not seen for a moment has not breathed.
    """
    return tuple(
        replace(state, is_inside=False)
        if state.stage in ENDED_BY
        else ConditionState(settled_at=state.settled_at, held_since_us=state.held_since_us, holds=state.holds)
        for state in states
    )


def left(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return what is remembered while the gate as a whole is not inside: who was inside has to enter again."""
    return tuple(replace(state, is_inside=False) for state in states)


def outside(state: ConditionState, reason: HoldReason | None, detail: str) -> WindowVerdict:
    """Say that the frame is outside, and why."""
    return WindowVerdict(is_inside=False, states=(replace(state, is_inside=False),), reason=reason, detail=detail)
