"""Events in the breathing, each from one simple sign, with how sure it is. In mm and s; see docs/breathing.md."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from engine.breath import BreathEvent, BreathEventKind
from engine.stages.breathing.habit import Habit

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Signs:
    """What a moment shows, gathered for the judgement.

    Attributes
    ----------
    height
        Of the signal over the last end of exhale, mean of 0.3 s.
    still_s, still_height
        How long it has been at rest, and how high over the last end of exhale.
    lost_s
        How long it has neither turned nor been disturbed.
    is_cough, cough_s, cough_bends
        Whether it has bent as a cough does, since when, and how often.
    quick, quick_s
        Points for inhales of late that were quicker than usual, and when the first was.
    drifts
        How far the last two ends of exhale are from where it was learned; None where that says nothing.
    scatter
        How the end of exhale scatters, standard deviation.
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


Events = tuple[BreathEvent, ...]


def find_event(events: Events, kind: BreathEventKind) -> BreathEvent | None:
    """Return the event of that kind that is under way."""
    return next((event for event in events if event.kind is kind), None)


def judge(events: Events, signs: Signs, habit: Habit | None) -> Events:
    """Return the events under way at this moment, the newest last."""
    events = _told(events, BreathEventKind.COUGH, _cough(signs), signs.cough_s)
    if habit is None or signs.is_cough:
        return events
    for kind, sign in _SIGNS.items():
        outcome = sign(events, signs, habit)
        if outcome is not None:
            events = _told(events, kind, *outcome)
    return events


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """That an event is under way, how sure, and in words."""

    confidence: float
    detail: str


Outcome = tuple[Found | None, float]
"""What was found, and since when; no outcome at all leaves things as they are."""


def _told(events: Events, kind: BreathEventKind, found: Found | None, start_s: float) -> Events:
    """Begin, renew or end one kind."""
    present = find_event(events, kind)
    if found is None:
        return events if present is None else tuple(event for event in events if event is not present)
    confidence = min(max(found.confidence, 0.0), 1.0)
    if present is None:
        new = BreathEvent(kind=kind, start_us=round(start_s * US_PER_S), confidence=confidence, detail=found.detail)
        return (*events, new)
    renewed = replace(present, confidence=max(confidence, present.confidence), detail=found.detail)
    return tuple(renewed if event is present else event for event in events)


def _cough(signs: Signs) -> Found | None:
    if not signs.is_cough:
        return None
    return Found(confidence=1.0 - 0.4 * 0.6 ** (signs.cough_bends - 3), detail=f"{signs.cough_bends} fast bends")


def _apnoea(_: Events, signs: Signs, habit: Habit) -> Outcome:
    start_s = signs.now_s - signs.still_s
    enough_s = still_enough_s(habit)
    if signs.still_s <= enough_s or signs.still_height > LOW_SHARE * habit.rise:
        return None, start_s
    sure = 0.7 + 0.3 * min(1.0, signs.still_s / enough_s - 1.0)
    return Found(confidence=sure, detail=f"no breath for {signs.still_s:.0f} s"), start_s


def still_enough_s(habit: Habit) -> float:
    """How long the signal rests before that is no pause any more [s]."""
    return min(max(MIN_APNOEA_S, APNOEA_PERIODS * habit.period_s), MAX_APNOEA_S)


def _sigh(events: Events, signs: Signs, habit: Habit) -> Outcome:
    present = find_event(events, BreathEventKind.SIGH)
    times = signs.height / habit.rise
    if present is None:
        is_irregular = find_event(events, BreathEventKind.IRREGULAR) is not None  # then no depth is usual
        if times < SIGH_SHARE or is_irregular:
            return None, signs.now_s
        return Found(confidence=min(1.0, 0.7 + 0.6 * (times - SIGH_SHARE)), detail=_times(times)), signs.now_s
    if times < SIGH_OVER_SHARE or signs.now_s - present.start_us / US_PER_S > SIGH_LONGEST_S:
        return None, signs.now_s
    return Found(confidence=min(1.0, 0.7 + 0.6 * (times - SIGH_SHARE)), detail=present.detail), signs.now_s


def _times(times: float) -> str:
    return f"{times:.1f} times a usual breath"


def _talking(events: Events, signs: Signs, _: Habit) -> Outcome:
    present = find_event(events, BreathEventKind.TALKING)
    if signs.quick < (ENOUGH_QUICK if present is None else 1):
        return None, signs.now_s
    return Found(confidence=0.5 + 0.15 * signs.quick, detail="quick in, long out"), signs.quick_s


def _irregular(events: Events, signs: Signs, habit: Habit) -> Outcome | None:
    if signs.quick:
        return None
    present = find_event(events, BreathEventKind.IRREGULAR)
    if signs.lost_s > LOST_PERIODS * habit.period_s and signs.still_s < still_enough_s(habit):
        return Found(confidence=0.8, detail=f"no breath can be told for {signs.lost_s:.0f} s"), signs.now_s
    if signs.regularity is None:
        return None, signs.now_s
    bound = IRREGULAR_BELOW if present is None else REGULAR_ABOVE
    if signs.regularity >= bound:
        return None, signs.now_s
    sure = 0.6 + 0.4 * min(1.0, (bound - signs.regularity) / 0.2)
    return Found(confidence=sure, detail="breaths differ from each other"), signs.now_s


def drift_bound_mm(habit: Habit, scatter: float) -> float:
    """How far the end of exhale may be from where it was learned [mm]."""
    return max(
        min(DRIFT_MM_PER_PERIOD_S * habit.period_s, MAX_DRIFT_MM),
        DRIFT_SHARE * habit.rise,
        min(DRIFT_SCATTERS * scatter, MAX_SCATTER_MM_PER_PERIOD_S * habit.period_s),
    )


def _drift(events: Events, signs: Signs, habit: Habit) -> Outcome | None:
    present = find_event(events, BreathEventKind.DRIFT)
    if signs.drifts is None:
        return None
    before, drift = signs.drifts
    bound = drift_bound_mm(habit, signs.scatter)
    if present is not None:
        bound *= DRIFT_OVER_SHARE
    # One odd breath is no drift: the end of exhale before must have gone the same way.
    goes_on = present is not None or before * drift >= STEADY_SHARE * drift * drift
    if abs(drift) <= bound or not goes_on:
        return None, signs.now_s
    way = "towards the camera" if drift > 0.0 else "away from the camera"
    return Found(
        confidence=min(1.0, 0.3 + 0.4 * abs(drift) / bound), detail=f"the end of exhale went {way}"
    ), signs.now_s


_SIGNS: dict[BreathEventKind, Callable[[Events, Signs, Habit], Outcome | None]] = {
    BreathEventKind.APNOEA: _apnoea,
    BreathEventKind.SIGH: _sigh,
    BreathEventKind.TALKING: _talking,
    BreathEventKind.DRIFT: _drift,
    BreathEventKind.IRREGULAR: _irregular,
}
