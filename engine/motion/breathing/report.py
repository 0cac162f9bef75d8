"""Output of the monitor: the phase if it is known, and the figures in the signal's own unit."""

import math

from engine.core.breath import Breath, SignalChoice
from engine.motion.breathing.breathing_habit import BreathingHabit
from engine.motion.breathing.breathing_history import INITIAL_BREATHS, LEARNED_CYCLES, BreathingHistory
from engine.motion.breathing.events import Events
from engine.motion.breathing.phase import WAIT_FOR_NONE, PhaseTrack, confidence_of

AFTER_GAP = "not measured for a moment"
NOT_MEASURED = "not measured"
HELD = "held"
LATE = "the breath is late"
ELSEWHERE = "the level does not match the phase"
DRIFTED = "the baseline has drifted"
APNOEA = "apnoea"
US_PER_S = 1e6
RATE_SPREAD = 0.35
SURE_REGULARITY = 0.8
DRIFT_SHARE = 1.0 / 3.0
MIN_DRIFT_MM = 2.0
MAX_DRIFT_MM = 5.0
"""Largest drift with a phase, as a share of a usual breath and within these bounds [mm]: the phase does not limit the
position, and such a drift is as large as the motion within a usual window."""


def breath_of(
    choice: SignalChoice, unit: float, history: BreathingHistory, track: PhaseTrack, events: Events, low: float
) -> Breath:
    """Return the breathing figures of a signal; ``unit`` converts internal mm to the signal's unit.

    ``low`` is the lowest level since the last end of inhale [mm], infinite before: an exhale that already lies lower
    than the last one counts for the drift.
    """
    habit = history.habit
    exhale_s, exhale = history.lows[-1] if history.lows else (None, math.nan)
    exhale_us = None if exhale_s is None else round(exhale_s * US_PER_S)
    drift = None if exhale_s is None or history.expected is None else (exhale - history.expected) * unit
    lower_by = max(0.0, exhale - low) * unit
    exhale_drift = None if drift is None else drift - lower_by
    if habit is None or (history.breaths_needed == INITIAL_BREATHS and history.reason == AFTER_GAP):
        return Breath(signal=choice, note=history.reason, events=events, exhale_us=exhale_us, exhale_drift=exhale_drift)
    phase, confidence, note = _phase(history, habit, track)
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


def _phase(history: BreathingHistory, habit: BreathingHabit, track: PhaseTrack) -> tuple[float | None, float, str]:
    if history.breaths_needed > 0 or not math.isfinite(track.reported):
        return None, 0.0, history.reason
    if track.late >= WAIT_FOR_NONE:
        return None, 0.0, LATE
    if history.expected is not None and not abs(history.low - history.expected) <= _drift_bound_mm(habit):
        return None, 0.0, DRIFTED
    trust = 0.5 if history.regularity is None else min(1.0, history.regularity / SURE_REGULARITY)
    return track.percent, trust * confidence_of(track, habit), ""


def _drift_bound_mm(habit: BreathingHabit) -> float:
    return min(max(MIN_DRIFT_MM, DRIFT_SHARE * habit.rise), MAX_DRIFT_MM)
