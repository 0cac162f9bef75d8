"""The phase: time since the end of inhale as a share of a usual breath, set right by every flank of the signal.

It is what 4-D CT calls phase, linear in time from one end of inhale (0 %) to the next, told before the next is seen. It
never runs ahead of the signal: before the breath is seen to rise it waits where a usual breath begins to rise, before
it is seen to fall, where a usual one begins to fall. It never goes back within a breath; where it is ahead, it waits.
"""

import math
from dataclasses import dataclass, replace

from engine.stages.breathing.habit import Habit
from engine.stages.breathing.turns import RISING

ERROR_SHARE = 0.35
WAIT_FOR_NONE = 25.0
"""Per cent of a breath that the signal may be late before there is no phase."""
ERROR_SCALE = 14.0
SPREAD_SCALE = 0.30


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseTrack:
    """What is remembered; phases are in per cent and count on from breath to breath.

    Attributes
    ----------
    anchor_s, anchor
        The last time at which the phase was known, and the phase then.
    shown
        The last phase that was told.
    limit
        How far it may run before the signal turns.
    late
        By how much it would have run past that.
    error
        How far off it was of late when it was set right, running mean.
    """

    anchor_s: float = 0.0
    anchor: float = 0.0
    shown: float = -math.inf
    limit: float = math.inf
    late: float = 0.0
    error: float = 0.0

    @property
    def percent(self) -> float:
        """The phase, from 0 and below 100."""
        percent = self.shown % 100.0
        return percent if 0.0 <= percent < 100.0 else 0.0


def set_right(track: PhaseTrack, habit: Habit, now_s: float, turn_s: float, way: int) -> PhaseTrack:
    """Take a turn that was just known: a rise, or a fall from an end of inhale at ``turn_s``."""
    if way == RISING:
        breath = math.floor(track.anchor / 100.0)
        phase = 100.0 * (breath + habit.up_share)
        anchor_s, limit = now_s, 100.0 * (breath + 1.0 + habit.down_share)
    else:
        breath = math.floor(track.anchor / 100.0) + 1
        phase = 100.0 * (breath + (now_s - turn_s) / habit.period_s)
        anchor_s, limit = now_s, 100.0 * (breath + habit.up_share)
    error = abs(_running(track, habit, now_s) - phase)
    # What was told meanwhile lies in this breath or the one before, whatever the anchor was.
    shown = track.shown if abs(track.shown - phase) < 100.0 else -math.inf
    anchored = replace(
        track,
        anchor_s=anchor_s,
        anchor=phase if way == RISING else min(phase, limit),
        shown=shown,
        limit=limit,
        late=0.0,
        error=track.error + ERROR_SHARE * (min(error, 50.0) - track.error),
    )
    return advance(anchored, habit, now_s)


def advance(track: PhaseTrack, habit: Habit, now_s: float) -> PhaseTrack:
    """Go on to a time."""
    running = _running(track, habit, now_s)
    return replace(track, shown=max(track.shown, min(running, track.limit)), late=max(0.0, running - track.limit))


def confidence_of(track: PhaseTrack, habit: Habit) -> float:
    """How far the phase can be trusted, 0 to 1: by how it was set right of late, and by how late the signal is."""
    spread = math.sqrt(max(0.0, 1.0 - habit.period_spread / SPREAD_SCALE))
    return max(0.0, 1.0 - track.late / WAIT_FOR_NONE) * math.exp(-0.5 * (track.error / ERROR_SCALE) ** 2) * spread


def _running(track: PhaseTrack, habit: Habit, now_s: float) -> float:
    return track.anchor + 100.0 * (now_s - track.anchor_s) / habit.period_s
