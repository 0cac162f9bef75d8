"""Detection of breathing events, each by one simple indicator, with a confidence. In mm and s.

Rules and bounds: docs/2-clinical/breathing.md.

Detects motion faster than any breath (coughs) by the bend of the signal within 0.3 s.

The bend is the distance of the value 0.15 s ago from the line between the values 0.3 s ago and now. A breath bends by
tenths of a millimetre, a cough by its whole height. One bump bends three times (down, up, down), a patient shift twice.
All in mm and s; a volume is scaled to mm.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from engine.core.breath import BreathEvent, BreathEventKind
from engine.core.replacing import replace
from engine.motion.breathing.breathing_habit import BreathingHabit

US_PER_S = 1e6
SIGH_SHARE = 1.5
SIGH_OVER_SHARE = 0.6
SIGH_LONGEST_S = 8.0
MIN_APNOEA_S = 4.5
MAX_APNOEA_S = 8.5
APNOEA_PERIODS = 1.25
LOW_SHARE = 0.4
QUICK_TIMES = 1.4
VERY_QUICK_TIMES = 1.8
ENOUGH_QUICK = 2
MOST_QUICK = 3
QUICK_RISE_SHARE = 0.4
QUICK_WAIT_SHARE = 0.55
TALK_OVER_PERIODS = 3.0
IRREGULAR_BELOW = 0.52
REGULAR_ABOVE = 0.62
LOST_PERIODS = 2.5
DRIFT_MM_PER_PERIOD_S = 0.15
MAX_DRIFT_MM = 1.2
DRIFT_SHARE = 0.045
DRIFT_SCATTERS = 4.0
MAX_SCATTER_MM_PER_PERIOD_S = 0.25
DRIFT_OVER_SHARE = 0.6
STEADY_SHARE = 0.3
Events = tuple[BreathEvent, ...]
ARM_S = 0.15
MIN_BEND_MM = 1.2
TIMES_USUAL = 7.0
SHARE_OF_AMPLITUDE = 0.1
USUAL_S = 15.0
"""Time constant over which the usual bend is learned [s]."""
SHORT_S = 1.2
MEMORY_S = 1.3
"""Longest time between two bends of a burst [s]."""
MIN_BENDS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Indicators:
    """Indicators of one moment.

    Attributes
    ----------
    height
        Height of the signal over the last end of exhale, mean of 0.3 s.
    still_s, still_height
        How long the signal has been at rest, and its height over the last end of exhale.
    lost_s
        Time since the last turning point or disturbance.
    is_cough, cough_s, cough_bends
        Whether there is a cough, its start, and its number of bends.
    quick, quick_s
        Score of recent inhales that were faster than usual, and the time of the first.
    drifts
        Distance of the last two ends of exhale from the expected level; None if unknown.
    scatter
        Standard deviation of the end of exhale.
    """

    now_s: float
    height: float
    still_s: float
    still_height: float
    lost_s: float
    is_cough: bool
    cough_s: float
    cough_bends: int
    quick: int
    quick_s: float
    regularity: float | None
    drifts: tuple[float, float] | None
    scatter: float


def find_event(events: Events, kind: BreathEventKind) -> BreathEvent | None:
    """Return the active event of that kind, if any."""
    for event in events:
        if event.kind is kind:
            return event
    return None


def update_events(events: Events, indicators: Indicators, habit: BreathingHabit | None) -> Events:
    """Return the active events, the newest last."""
    events = _updated(events, BreathEventKind.COUGH, _cough(indicators), indicators.cough_s)
    if habit is None or indicators.is_cough:
        return events
    for kind, sign in _RULES.items():
        outcome = sign(events, indicators, habit)
        if outcome is not None:
            events = _updated(events, kind, *outcome)
    return events


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """A detected event: confidence and a description."""

    confidence: float
    detail: str


Outcome = tuple[Detection | None, float]
"""The detection and its start [s]; None instead of an outcome leaves the event unchanged."""


def _updated(events: Events, kind: BreathEventKind, detection: Detection | None, start_s: float) -> Events:
    """Start, update or end the event of one kind."""
    present = find_event(events, kind)
    if detection is None:
        return events if present is None else tuple(event for event in events if event is not present)
    confidence = min(max(detection.confidence, 0.0), 1.0)
    if present is None:
        new = BreathEvent(kind=kind, start_us=round(start_s * US_PER_S), confidence=confidence, detail=detection.detail)
        return (*events, new)
    renewed = replace(present, confidence=max(confidence, present.confidence), detail=detection.detail)
    return tuple(renewed if event is present else event for event in events)


def _cough(indicators: Indicators) -> Detection | None:
    if not indicators.is_cough:
        return None
    return Detection(
        confidence=1.0 - 0.4 * 0.6 ** (indicators.cough_bends - 3), detail=f"{indicators.cough_bends} fast bends"
    )


def _apnoea(_: Events, indicators: Indicators, habit: BreathingHabit) -> Outcome:
    start_s = indicators.now_s - indicators.still_s
    enough_s = still_enough_s(habit)
    if indicators.still_s <= enough_s or indicators.still_height > LOW_SHARE * habit.rise:
        return None, start_s
    confidence = 0.7 + 0.3 * min(1.0, indicators.still_s / enough_s - 1.0)
    return Detection(confidence=confidence, detail=f"no breath for {indicators.still_s:.0f} s"), start_s


def still_enough_s(habit: BreathingHabit) -> float:
    """Shortest rest that counts as apnoea [s]."""
    return min(max(MIN_APNOEA_S, APNOEA_PERIODS * habit.period_s), MAX_APNOEA_S)


def _sigh(events: Events, indicators: Indicators, habit: BreathingHabit) -> Outcome:
    present = find_event(events, BreathEventKind.SIGH)
    times = indicators.height / habit.rise
    if present is None:
        is_irregular = find_event(events, BreathEventKind.IRREGULAR) is not None  # without a usual depth
        if times < SIGH_SHARE or is_irregular:
            return None, indicators.now_s
        return Detection(confidence=min(1.0, 0.7 + 0.6 * (times - SIGH_SHARE)), detail=_times(times)), indicators.now_s
    if times < SIGH_OVER_SHARE or indicators.now_s - present.start_us / US_PER_S > SIGH_LONGEST_S:
        return None, indicators.now_s
    return Detection(confidence=min(1.0, 0.7 + 0.6 * (times - SIGH_SHARE)), detail=present.detail), indicators.now_s


def _times(times: float) -> str:
    return f"{times:.1f} times a usual breath"


def _talking(events: Events, indicators: Indicators, _: BreathingHabit) -> Outcome:
    present = find_event(events, BreathEventKind.TALKING)
    if indicators.quick < (ENOUGH_QUICK if present is None else 1):
        return None, indicators.now_s
    return Detection(confidence=0.5 + 0.15 * indicators.quick, detail="quick in, long out"), indicators.quick_s


def _no_cycle(_: Events, indicators: Indicators, habit: BreathingHabit) -> Outcome:
    is_lost = indicators.lost_s > LOST_PERIODS * habit.period_s and indicators.still_s < still_enough_s(habit)
    if not is_lost:
        return None, indicators.now_s
    return Detection(confidence=0.8, detail=f"no breath detected for {indicators.lost_s:.0f} s"), indicators.now_s


def _irregular(events: Events, indicators: Indicators, habit: BreathingHabit) -> Outcome | None:
    if indicators.quick:
        return None
    present = find_event(events, BreathEventKind.IRREGULAR)
    lost, since_s = _no_cycle(events, indicators, habit)
    if lost is not None:
        return lost, since_s
    if indicators.regularity is None:
        return None, indicators.now_s
    bound = IRREGULAR_BELOW if present is None else REGULAR_ABOVE
    if indicators.regularity >= bound:
        return None, indicators.now_s
    confidence = 0.6 + 0.4 * min(1.0, (bound - indicators.regularity) / 0.2)
    return Detection(confidence=confidence, detail="breaths differ from each other"), indicators.now_s


def drift_bound_mm(habit: BreathingHabit, scatter: float) -> float:
    """Largest distance of the end of exhale from its expected level without a drift event [mm]."""
    return max(
        min(DRIFT_MM_PER_PERIOD_S * habit.period_s, MAX_DRIFT_MM),
        DRIFT_SHARE * habit.rise,
        min(DRIFT_SCATTERS * scatter, MAX_SCATTER_MM_PER_PERIOD_S * habit.period_s),
    )


def _drift(events: Events, indicators: Indicators, habit: BreathingHabit) -> Outcome | None:
    present = find_event(events, BreathEventKind.DRIFT)
    if indicators.drifts is None:
        return None
    before, drift = indicators.drifts
    bound = drift_bound_mm(habit, indicators.scatter)
    if present is not None:
        bound *= DRIFT_OVER_SHARE
    # A single breath is no drift: the previous end of exhale must deviate in the same direction.
    goes_on = present is not None or before * drift >= STEADY_SHARE * drift * drift
    if abs(drift) <= bound or not goes_on:
        return None, indicators.now_s
    direction = "towards the camera" if drift > 0.0 else "away from the camera"
    return Detection(
        confidence=min(1.0, 0.3 + 0.4 * abs(drift) / bound), detail=f"the end of exhale went {direction}"
    ), indicators.now_s


_RULES: dict[BreathEventKind, Callable[[Events, Indicators, BreathingHabit], Outcome | None]] = {
    BreathEventKind.APNOEA: _apnoea,
    BreathEventKind.SIGH: _sigh,
    BreathEventKind.TALKING: _talking,
    BreathEventKind.DRIFT: _drift,
    BreathEventKind.NO_CYCLE: _no_cycle,
    BreathEventKind.IRREGULAR: _irregular,
}


class Sample(NamedTuple):
    """One value of the signal."""

    seconds: float
    value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Spikes:
    """State of the detector.

    Attributes
    ----------
    recent
        Samples of the last 0.3 s.
    usual, short
        Mean size of the bend over a long time and over about one second [mm].
    since_s
        Time over which the usual bend was learned [s].
    sign, bends
        Sign of the current burst's last bend, and the number of its bends of alternating sign.
    first_s, last_s
        Start of the burst, and its last bend [s].
    """

    recent: tuple[Sample, ...] = ()
    usual: float = 0.0
    short: float = 0.0
    since_s: float = 0.0
    sign: int = 0
    bends: int = 0
    first_s: float = 0.0
    last_s: float = -1e9

    def is_cough(self, now_s: float) -> bool:
        """Whether the current burst has enough bends and the last is recent."""
        return self.bends >= MIN_BENDS and now_s - self.last_s <= MEMORY_S


def follow_spikes(spikes: Spikes, seconds: float, value: float, amplitude: float) -> Spikes:
    """Add a frame's value; ``amplitude`` is that of a usual breath [mm], 0 if unknown."""
    recent = (*_since(spikes.recent, seconds - 2.0 * ARM_S), Sample(seconds, value))
    bend = _bend(recent)
    if bend is None:
        return replace(spikes, recent=recent)
    size = abs(bend)
    limit = max(MIN_BEND_MM, TIMES_USUAL * spikes.usual, SHARE_OF_AMPLITUDE * amplitude)
    bounded, step_s = min(size, limit), seconds - recent[-2].seconds
    learned = replace(
        spikes,
        recent=recent,
        usual=spikes.usual + step_s / max(step_s, min(USUAL_S, spikes.since_s + step_s)) * (bounded - spikes.usual),
        short=spikes.short + step_s / max(step_s, SHORT_S) * (bounded - spikes.short),
        since_s=min(spikes.since_s + step_s, USUAL_S),
    )
    return _counted(learned, seconds, 1 if bend > 0.0 else -1) if size > limit else learned


def _counted(spikes: Spikes, seconds: float, sign: int) -> Spikes:
    if seconds - spikes.last_s > MEMORY_S:
        return replace(spikes, sign=sign, bends=1, first_s=seconds, last_s=seconds)
    return replace(spikes, sign=sign, bends=spikes.bends + (sign != spikes.sign), last_s=seconds)


def _since(recent: tuple[Sample, ...], from_s: float) -> tuple[Sample, ...]:
    """Keep the samples after a time, and the last one before it."""
    first = 0
    while first + 1 < len(recent) and recent[first + 1].seconds <= from_s + 1e-6:
        first += 1
    return recent[first:]


def _bend(recent: tuple[Sample, ...]) -> float | None:
    """Distance of the middle sample from the line between first and last [mm]; None for fewer than three samples."""
    if len(recent) < 3:
        return None
    begin, end = recent[0], recent[-1]
    middle_s = 0.5 * (begin.seconds + end.seconds)
    middle, least_s = begin, math.inf
    for sample in recent[1:-1]:
        apart_s = abs(sample.seconds - middle_s)
        if apart_s < least_s:
            middle, least_s = sample, apart_s
    share = (middle.seconds - begin.seconds) / (end.seconds - begin.seconds)
    return middle.value - begin.value - share * (end.value - begin.value)
