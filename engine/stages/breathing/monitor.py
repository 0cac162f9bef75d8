"""Follows one breathing signal, a value a frame, and says where in the breath the patient is and what goes on.

A pure fold: state goes in and comes out, nothing is looked up and no clock is read. It knows no future: an end of
inhale is known once the signal has left it, and until then its place is told from the breaths before. Inside, a
volume is scaled so that a tenth of a litre counts as a millimetre, about what it lifts the skin by.
"""

import math
from dataclasses import dataclass, field, replace

from engine.breath import Breath, BreathEventKind, SignalChoice
from engine.stages.breathing import events as judging
from engine.stages.breathing import known as knowing
from engine.stages.breathing.bins import Bins, follow_bins
from engine.stages.breathing.body import Place, is_elsewhere
from engine.stages.breathing.course import Course, gone_on, lifted, turned
from engine.stages.breathing.habit import Habit
from engine.stages.breathing.known import MISSING_AT_FIRST, Known, doubting
from engine.stages.breathing.phase import PhaseTrack, advance, set_right
from engine.stages.breathing.spikes import Spikes, follow_spikes
from engine.stages.breathing.telling import AFTER_GAP, APNOEA, ELSEWHERE, HELD, NOT_MEASURED, tell
from engine.stages.breathing.turns import FALLING, RISING, UNKNOWN, Turns, follow_turns

LITRES_PER_MM = 0.1
GAP_S = 0.55
SMOOTHING_S = 0.08
TURN_SHARE = 0.3
FIRST_TURN_SHARE = 0.35
MIN_TURN_MM = 0.8
TURN_DECAY_AFTER = 0.9
MAX_ABS_MM = 1e6
MAX_S = 1e12
FIRST_BINS = 80
COUGH = "cough"
NO_PHASE = {
    BreathEventKind.APNOEA: (1, APNOEA),
    BreathEventKind.TALKING: (1, "talking"),
    BreathEventKind.IRREGULAR: (MISSING_AT_FIRST, "irregular"),
}
"""Events in which no phase is told, how many consistent breaths it takes afterwards, and what is said meanwhile."""
DISTURBING = {BreathEventKind.APNOEA, BreathEventKind.TALKING}


@dataclass(frozen=True, slots=True, kw_only=True)
class BreathingState:
    """What is remembered between frames; all but ``breath`` in mm, a volume scaled.

    Attributes
    ----------
    seconds
        Device time of the last value; None before the first.
    fast
        The signal, smoothed over 0.08 s.
    first
        Levels seen before there was a complete breath: how deep it may be.
    breath
        What is told.
    """

    choice: SignalChoice
    seconds: float | None = None
    fast: float = 0.0
    spikes: Spikes = field(default_factory=Spikes)
    bins: Bins = field(default_factory=Bins)
    turns: Turns = field(default_factory=Turns)
    track: PhaseTrack = field(default_factory=PhaseTrack)
    course: Course = field(default_factory=Course)
    known: Known = field(default_factory=Known)
    first: tuple[float, ...] = ()
    events: judging.Events = ()
    breath: Breath

    @property
    def unit(self) -> float:
        """How much of the signal counts as a millimetre."""
        return LITRES_PER_MM if self.choice.is_volume else 1.0


def start_breathing(choice: SignalChoice) -> BreathingState:
    """Begin to follow a signal, with nothing seen."""
    return BreathingState(choice=choice, breath=Breath(signal=choice))


def with_baseline(state: BreathingState, baseline: float) -> BreathingState:
    """Let drift be told against this level of the end of exhale from now on [mm, l of the volume]."""
    if not abs(baseline) <= MAX_ABS_MM:
        return state
    events = tuple(event for event in state.events if event.kind is not BreathEventKind.DRIFT)
    known = replace(state.known, learned=baseline / state.unit, correction=0.0)
    return _telling(replace(state, known=known, events=events))


def correct_baseline(state: BreathingState, by: float) -> BreathingState:
    """Let drift be told against a level so much higher than the learned one [mm, l of the volume]; 0 takes it back."""
    if not abs(by) <= MAX_ABS_MM:
        return state
    events = tuple(event for event in state.events if event.kind is not BreathEventKind.DRIFT)
    return _telling(replace(state, known=replace(state.known, correction=by / state.unit), events=events))


def shifted(state: BreathingState, by: float) -> BreathingState:
    """Move all that is remembered: the signal has another zero from now on [mm, l of the volume]."""
    if not abs(by) <= MAX_ABS_MM:  # the signal itself is no number now
        return state
    mm = by / state.unit
    spikes, bins, turns, course = state.spikes, state.bins, state.turns, state.course
    return _telling(
        replace(
            state,
            fast=state.fast + mm,
            first=tuple(level + mm for level in state.first),
            spikes=replace(spikes, recent=tuple(one._replace(value=one.value + mm) for one in spikes.recent)),
            bins=replace(
                bins,
                values=tuple(value + mm for value in bins.values),
                total=bins.total + bins.count * mm,
                still_at=bins.still_at + mm,
            ),
            turns=replace(turns, high=turns.high + mm, low=turns.low + mm),
            course=lifted(course, mm),
            known=knowing.moved(state.known, mm),
        )
    )


def lose_breathing(state: BreathingState) -> BreathingState:
    """Take a frame whose value is not known: nothing is told of it."""
    return replace(state, breath=Breath(signal=state.choice, note=NOT_MEASURED))


def follow_breathing(state: BreathingState, seconds: float, value: float) -> BreathingState:
    """Take a frame's value.

    Parameters
    ----------
    seconds
        Device time of the frame [s].
    value
        The signal [mm, l of the volume], inhale up, any offset; NaN is a value that could not be measured.
    """
    mm = value / state.unit
    if not (abs(seconds) < MAX_S and abs(mm) <= MAX_ABS_MM):  # not true of NaN
        return lose_breathing(state)
    if state.seconds is None or seconds < state.seconds:
        return _begun(state, seconds, mm)
    if seconds == state.seconds:
        return state
    if seconds - state.seconds > GAP_S:
        return _interrupted(state, seconds, mm)
    return _telling(_followed(state, state.seconds, seconds, mm))


def _followed(state: BreathingState, before_s: float, seconds: float, mm: float) -> BreathingState:
    """Take the next value of a signal without a gap."""
    fast = state.fast + (1.0 - math.exp((before_s - seconds) / SMOOTHING_S)) * (mm - state.fast)
    spikes = follow_spikes(state.spikes, seconds, mm, state.known.rise)
    bins, is_closed = follow_bins(state.bins, seconds, mm, state.known.rise)
    is_coughing = spikes.is_cough(seconds)
    if is_coughing or judging.find_event(state.events, BreathEventKind.COUGH) is not None:
        state = _coughed(replace(state, seconds=seconds, fast=fast, spikes=spikes, bins=bins), seconds)
        return _judged(state, seconds)
    turns, has_turned = follow_turns(state.turns, seconds, fast, _threshold(state, seconds))
    track, habit, was = state.track, state.known.habit, state.turns.way
    if habit is not None and not has_turned:
        track = advance(track, habit, seconds)
    state = replace(state, seconds=seconds, fast=fast, spikes=spikes, bins=bins, turns=turns, track=track)
    if has_turned:
        state = _turned(state, seconds, was)
    return _placed(_judged(state, seconds) if is_closed else state, seconds)


def _placed(state: BreathingState, seconds: float) -> BreathingState:
    """Tell no phase before another consistent breath where the body is not where the phase says."""
    known, track, habit = state.known, state.track, state.known.habit
    if habit is None or known.missing > 0 or not math.isfinite(track.shown):
        return state
    place = Place(track.percent, track.late > 0.0, known.low, seconds, state.fast)
    if not is_elsewhere(place, habit, state.turns, state.course):
        return state
    return replace(state, known=doubting(known, 1, ELSEWHERE))


def _telling(state: BreathingState) -> BreathingState:
    return replace(state, breath=tell(state.choice, state.unit, state.known, state.track, state.events))


def _begun(state: BreathingState, seconds: float, mm: float) -> BreathingState:
    """Begin with this value; where the end of exhale was learned is kept, for the patient is the same."""
    fresh = replace(
        start_breathing(state.choice),
        known=Known(learned=state.known.learned, correction=state.known.correction),
        seconds=seconds,
        fast=mm,
    )
    return replace(fresh, spikes=follow_spikes(fresh.spikes, seconds, mm, 0.0))


def _interrupted(state: BreathingState, seconds: float, mm: float) -> BreathingState:
    """Go on after a gap: what is usual is kept, where in the breath the patient is has to be found again."""
    usual = replace(Spikes(), usual=state.spikes.usual, since_s=state.spikes.since_s)
    lasting = tuple(event for event in state.events if event.kind is BreathEventKind.DRIFT)
    known = replace(doubting(state.known, MISSING_AT_FIRST, AFTER_GAP), watched_s=None, quick=0)
    state = replace(_restarted(state, seconds), seconds=seconds, fast=mm, bins=Bins(), events=lasting, known=known)
    return _telling(replace(state, spikes=follow_spikes(usual, seconds, mm, state.known.rise)))


def _restarted(state: BreathingState, seconds: float) -> BreathingState:
    """Forget the breath under way."""
    return replace(state, turns=Turns(turned_s=seconds), course=Course(), track=PhaseTrack())


def _coughed(state: BreathingState, seconds: float) -> BreathingState:
    """Follow no turns in a cough; what its first spikes made of the breath is taken back."""
    known = doubting(state.known, 1, COUGH)
    known = knowing.without_since(known, state.spikes.first_s - 2.0 * SMOOTHING_S)
    known = replace(known, disturbed_s=seconds, watched_s=None)
    return replace(_restarted(state, seconds), known=known)


def _threshold(state: BreathingState, seconds: float) -> float:
    """How far the signal must leave an extreme for that to be a turn [mm]."""
    habit = state.known.habit
    if habit is None:
        reach = max(state.first) - min(state.first) if state.first else 0.0
        return max(MIN_TURN_MM, FIRST_TURN_SHARE * reach)
    late = (seconds - state.turns.turned_s) / habit.period_s - TURN_DECAY_AFTER
    share = TURN_SHARE * (math.exp(-late) if late > 0.0 else 1.0)  # breathing may have become shallow
    return max(MIN_TURN_MM, share * habit.rise)


def _turned(state: BreathingState, seconds: float, was: int) -> BreathingState:
    """Take a turn: the end of an exhale is known, or a complete breath."""
    turns, known = state.turns, state.known
    # The smoothed signal is late by as much as it is smoothed.
    timely = replace(turns, high_s=turns.high_s - SMOOTHING_S, low_s=turns.low_s - SMOOTHING_S)
    course, cycle = turned(state.course, timely, seconds)
    if was == UNKNOWN and turns.way == FALLING:
        return replace(state, course=Course())  # the signal may have begun on its way down: that was no end of inhale
    if turns.way == RISING:
        known = knowing.with_low(known, timely.low_s, state.course.low if was != UNKNOWN else math.nan)
    else:
        known = knowing.with_inhale(known, seconds, state.course.speed, turns.high - state.course.trough)
        known = known if cycle is None else knowing.with_breath(known, cycle)
    track = state.track
    if known.habit is not None:
        track = set_right(track, known.habit, seconds, timely.high_s, turns.way)
    return replace(state, course=course, known=known, track=track)


# -- ten times a second -----------------------------------------------------------------------------------------


def _judged(state: BreathingState, seconds: float) -> BreathingState:
    """Judge what goes on."""
    bins, known = state.bins, knowing.watched(state.known, seconds)
    course = gone_on(state.course, bins.level if bins.is_level_known else None, bins.speed, (seconds, state.fast))
    first = (*state.first, bins.short_level)[-FIRST_BINS:] if known.habit is None and bins.values else ()
    events = judging.judge(state.events, _signs(state, known, seconds), known.habit)
    for event in events:
        if event.kind in NO_PHASE:
            known = doubting(known, *NO_PHASE[event.kind])
    is_held = known.habit is not None and _is_held(state, known, known.habit, seconds)
    if is_held:
        known = doubting(known, 1, HELD)
    if is_held or any(event.kind in DISTURBING for event in events):
        known = replace(known, disturbed_s=seconds)
    return replace(state, course=course, first=first, events=events, known=known)


def _is_held(state: BreathingState, known: Known, habit: Habit, seconds: float) -> bool:
    """Whether the breath is held anywhere but at the end of exhale."""
    is_still = seconds - state.bins.still_s > judging.still_enough_s(habit)
    return is_still and state.bins.still_at - known.low > judging.LOW_SHARE * habit.rise


def _signs(state: BreathingState, known: Known, seconds: float) -> judging.Signs:
    spikes, bins = state.spikes, state.bins
    return judging.Signs(
        now_s=seconds,
        height=bins.short_level - known.low,
        still_s=seconds - bins.still_s,
        still_height=bins.still_at - known.low,
        lost_s=seconds - max(state.turns.turned_s, known.disturbed_s),
        is_cough=spikes.is_cough(seconds),
        cough_s=spikes.first_s,
        cough_bends=spikes.bends,
        quick=known.quick,
        quick_s=known.quick_s,
        regularity=known.regularity,
        drifts=_drifts(state, known),
        scatter=known.scatter,
    )


def _drifts(state: BreathingState, known: Known) -> tuple[float, float] | None:
    """How far the last two ends of exhale are from where it was learned; one under way counts where it is lower."""
    expected = known.expected
    if expected is None or len(known.lows) < 2 or known.lows[-2][0] < known.disturbed_s:
        return None
    before, last = (low - expected for _, low in known.lows[-2:])
    now = state.course.low - expected
    return (last, now) if state.turns.way == FALLING and now < min(last, 0.0) else (before, last)
