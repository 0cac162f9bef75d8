"""What is told of a breath: the phase where it is known, and the figures in the signal's own unit."""

import math

from engine.breath import Breath, SignalChoice
from engine.stages.breathing.events import Events
from engine.stages.breathing.habit import Habit
from engine.stages.breathing.known import LEARNED_CYCLES, MISSING_AT_FIRST, Known
from engine.stages.breathing.phase import WAIT_FOR_NONE, PhaseTrack, confidence_of

AFTER_GAP = "nothing was measured for a moment"
NOT_MEASURED = "not measured"
HELD = "held"
LATE = "the breath is late"
ELSEWHERE = "the body is not where the phase says"
DRIFTED = "the baseline has drifted"
APNOEA = "apnoea"
RATE_SPREAD = 0.35
SURE_REGULARITY = 0.8
DRIFT_SHARE = 1.0 / 3.0
MIN_DRIFT_MM = 2.0
MAX_DRIFT_MM = 5.0
"""No phase beyond so much drift, as a share of a usual breath, and within these bounds: a phase bounds no position, and
the body then lies by as much elsewhere as it moves within a usual window."""


def tell(choice: SignalChoice, unit: float, known: Known, track: PhaseTrack, events: Events) -> Breath:
    """Tell where a signal stands; ``unit`` is what a millimetre inside is of the signal's own unit."""
    habit = known.habit
    if habit is None or (known.missing == MISSING_AT_FIRST and known.why == AFTER_GAP):
        return Breath(signal=choice, note=known.why, events=events)
    phase, confidence, note = _phase(known, habit, track)
    has_low = bool(known.lows)
    is_breathing = known.missing == 0 or known.why not in {HELD, APNOEA}
    return Breath(
        signal=choice,
        phase_percent=phase,
        phase_confidence=confidence,
        note=note,
        rate_per_min=60.0 / habit.period_s if is_breathing else None,
        rate_confidence=_rate_confidence(known, habit) if is_breathing else 0.0,
        amplitude=habit.rise * unit,
        baseline=known.low * unit if has_low else None,
        drift=(known.low - known.expected) * unit if has_low and known.expected is not None else None,
        drift_per_s=None if known.speed is None else known.speed * unit,
        regularity=known.regularity,
        events=events,
    )


def _rate_confidence(known: Known, habit: Habit) -> float:
    return max(0.0, 1.0 - habit.period_spread / RATE_SPREAD) * min(1.0, len(known.cycles) / LEARNED_CYCLES)


def _phase(known: Known, habit: Habit, track: PhaseTrack) -> tuple[float | None, float, str]:
    if known.missing > 0 or not math.isfinite(track.shown):
        return None, 0.0, known.why
    if track.late >= WAIT_FOR_NONE:
        return None, 0.0, LATE
    if known.expected is not None and not abs(known.low - known.expected) <= _drift_bound_mm(habit):
        return None, 0.0, DRIFTED
    trust = 0.5 if known.regularity is None else min(1.0, known.regularity / SURE_REGULARITY)
    return track.percent, trust * confidence_of(track, habit), ""


def _drift_bound_mm(habit: Habit) -> float:
    return min(max(MIN_DRIFT_MM, DRIFT_SHARE * habit.rise), MAX_DRIFT_MM)
