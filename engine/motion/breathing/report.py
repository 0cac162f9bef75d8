"""Output of the monitor: the phase if it is known, and the figures in the signal's own unit.

Breathing phase: time since the end of inhale over the usual period, synchronised at every flank of the signal.

As in 4-D CT, the phase is linear in time from one end of inhale (0 %) to the next, but predicted before the next one is
seen. It does not run ahead of the signal: until a rise is detected it stops at the phase at which a usual breath rises,
until a fall is detected, at the phase at which a usual breath falls. It never decreases within a breath; if it is ahead
after a synchronisation, it waits.
"""

import math
from dataclasses import dataclass

from engine.core.breath import Breath, SignalChoice
from engine.core.replacing import replace
from engine.core.sentences import say
from engine.motion.breathing.breathing_habit import BreathingHabit
from engine.motion.breathing.breathing_history import INITIAL_BREATHS, LEARNED_CYCLES, BreathingHistory
from engine.motion.breathing.cycles import RISING
from engine.motion.breathing.events import Events

ERROR_SHARE = 0.35
WAIT_FOR_NONE = 25.0
"""Largest delay of the signal with a phase [% of a breath]."""
ERROR_SCALE = 14.0
SPREAD_SCALE = 0.30
AFTER_GAP = say("not measured for a moment")
NOT_MEASURED = say("not measured")
HELD = "held"
LATE = say("the breath is late")
ELSEWHERE = say("the level does not match the phase")
DRIFTED = say("the baseline has drifted")
APNOEA = "apnoea"
US_PER_S = 1e6
RATE_SPREAD = 0.35
SURE_REGULARITY = 0.8
DRIFT_SHARE = 1.0 / 3.0
MIN_DRIFT_MM = 2.0
MAX_DRIFT_MM = 5.0
"""Largest drift with a phase, as a share of a usual breath and within these bounds [mm]: the phase does not limit the
position, and such a drift is as large as the motion within a usual window."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseTrack:
    """State of the phase; phases are in per cent and accumulate from breath to breath.

    Attributes
    ----------
    anchor_s, anchor
        Time of the last synchronisation [s], and the phase then.
    reported
        Last reported phase.
    limit
        Phase at which it stops until the next flank.
    late
        How far the prediction is beyond the limit.
    error
        Running mean of the correction at synchronisations.
    """

    anchor_s: float = 0.0
    anchor: float = 0.0
    reported: float = -math.inf
    limit: float = math.inf
    late: float = 0.0
    error: float = 0.0

    @property
    def percent(self) -> float:
        """The phase, 0 to below 100."""
        percent = self.reported % 100.0
        return percent if 0.0 <= percent < 100.0 else 0.0


def synchronise(track: PhaseTrack, habit: BreathingHabit, now_s: float, turn_s: float, direction: int) -> PhaseTrack:
    """Synchronise at a detected flank: a rise, or a fall after an end of inhale at ``turn_s`` [s]."""
    if direction == RISING:
        breath = math.floor(track.anchor / 100.0)
        phase = 100.0 * (breath + habit.up_share)
        anchor_s, limit = now_s, 100.0 * (breath + 1.0 + habit.down_share)
    else:
        breath = math.floor(track.anchor / 100.0) + 1
        phase = 100.0 * (breath + (now_s - turn_s) / habit.period_s)
        anchor_s, limit = now_s, 100.0 * (breath + habit.up_share)
    error = abs(_running(track, habit, now_s) - phase)
    # The reported phase belongs to this breath or the previous one, whatever the anchor was.
    reported = track.reported if abs(track.reported - phase) < 100.0 else -math.inf
    anchored = replace(
        track,
        anchor_s=anchor_s,
        anchor=phase if direction == RISING else min(phase, limit),
        reported=reported,
        limit=limit,
        late=0.0,
        error=track.error + ERROR_SHARE * (min(error, 50.0) - track.error),
    )
    return advance(anchored, habit, now_s)


def advance(track: PhaseTrack, habit: BreathingHabit, now_s: float) -> PhaseTrack:
    """Advance the phase to a time [s]."""
    running = _running(track, habit, now_s)
    return replace(track, reported=max(track.reported, min(running, track.limit)), late=max(0.0, running - track.limit))


def confidence_of(track: PhaseTrack, habit: BreathingHabit) -> float:
    """Confidence of the phase, 0 to 1, from recent corrections, the spread of periods and the signal's delay."""
    spread = math.sqrt(max(0.0, 1.0 - habit.period_spread / SPREAD_SCALE))
    return max(0.0, 1.0 - track.late / WAIT_FOR_NONE) * math.exp(-0.5 * (track.error / ERROR_SCALE) ** 2) * spread


def _running(track: PhaseTrack, habit: BreathingHabit, now_s: float) -> float:
    return track.anchor + 100.0 * (now_s - track.anchor_s) / habit.period_s


def breath_of(choice: SignalChoice, history: BreathingHistory, track: PhaseTrack, events: Events, low: float) -> Breath:
    """Return the breathing figures of a signal, in its unit.

    ``low`` is the lowest level since the last end of inhale [mm], infinite before: an exhale that already lies lower
    than the last one counts for the drift.
    """
    habit, unit = history.habit, choice.per_mm
    exhale_s, exhale = history.lows[-1] if history.lows else (None, math.nan)
    exhale_us = None if exhale_s is None else round(exhale_s * US_PER_S)
    expected = history.expected
    away = math.nan if expected is None else exhale - expected
    drift = None if math.isnan(away) else away * unit
    lower_by = max(0.0, exhale - low) * unit
    exhale_drift = None if drift is None else drift - lower_by
    if habit is None or (history.breaths_needed == INITIAL_BREATHS and history.reason == AFTER_GAP):
        return Breath(signal=choice, note=history.reason, events=events, exhale_us=exhale_us, exhale_drift=exhale_drift)
    phase, confidence, note = _phase(history, habit, track, None if expected is None else away)
    is_breathing = history.breaths_needed == 0 or history.reason not in {HELD, APNOEA}
    return Breath(
        signal=choice,
        phase_percent=phase,
        phase_confidence=confidence,
        note=note,
        rate_per_min=60.0 / habit.period_s if is_breathing else None,
        rate_confidence=_rate_confidence(history, habit) if is_breathing else 0.0,
        amplitude=habit.rise * unit,
        baseline=None if exhale_s is None else exhale * unit,
        drift=drift,
        exhale_us=exhale_us,
        exhale_drift=exhale_drift,
        drift_per_s=None if history.speed is None else history.speed * unit,
        regularity=history.regularity,
        events=events,
    )


def _rate_confidence(history: BreathingHistory, habit: BreathingHabit) -> float:
    return max(0.0, 1.0 - habit.period_spread / RATE_SPREAD) * min(1.0, len(history.cycles) / LEARNED_CYCLES)


def _phase(
    history: BreathingHistory, habit: BreathingHabit, track: PhaseTrack, away: float | None
) -> tuple[float | None, float, str]:
    """Return phase, confidence and note; ``away`` is the distance of the last end of exhale from the expected level."""
    if history.breaths_needed > 0 or not math.isfinite(track.reported):
        return None, 0.0, history.reason
    if track.late >= WAIT_FOR_NONE:
        return None, 0.0, LATE
    if away is not None and not abs(away) <= min(max(MIN_DRIFT_MM, DRIFT_SHARE * habit.rise), MAX_DRIFT_MM):
        return None, 0.0, DRIFTED
    trust = 0.5 if history.regularity is None else min(1.0, history.regularity / SURE_REGULARITY)
    return track.percent, trust * confidence_of(track, habit), ""
