"""Online breathing monitor of one signal: phase, rate, baseline, drift and events, one value per frame.

A pure fold: state goes in and comes out, no clock is read. It is causal: an end of inhale is known only after the
signal has left it; until then the phase is predicted from the previous breaths. Internally a volume is scaled so that
0.1 l counts as 1 mm, about the corresponding motion of the skin.
"""

import math
from dataclasses import dataclass, field

from engine.core.breath import Breath, BreathEventKind, SignalChoice
from engine.core.replacing import replace
from engine.motion.breathing import breathing_history as histories, events as event_rules
from engine.motion.breathing.breathing_habit import BreathingHabit
from engine.motion.breathing.breathing_history import INITIAL_BREATHS, BreathingHistory, suspending
from engine.motion.breathing.cycles import (
    FALLING,
    RISING,
    UNKNOWN,
    Bins,
    TurningPoints,
    follow_bins,
    follow_turns,
)
from engine.motion.breathing.events import Spikes, follow_spikes
from engine.motion.breathing.position_check import (
    CurrentBreath,
    ExpectedPosition,
    contradicts_phase,
    shifted_breath,
    with_bin,
    with_turn,
)
from engine.motion.breathing.report import (
    AFTER_GAP,
    APNOEA,
    ELSEWHERE,
    HELD,
    NOT_MEASURED,
    PhaseTrack,
    advance,
    breath_of,
    synchronise,
)

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
    BreathEventKind.IRREGULAR: (INITIAL_BREATHS, "irregular"),
}
"""Events without a phase: number of consistent breaths needed afterwards, and the note until then."""
DISTURBING = {BreathEventKind.APNOEA, BreathEventKind.TALKING}


@dataclass(frozen=True, slots=True, kw_only=True)
class BreathingState:
    """State between frames; all but ``breath`` in mm, a volume scaled.

    Attributes
    ----------
    seconds
        Device time of the last value [s]; None before the first.
    fast
        The signal, smoothed over 0.08 s.
    first
        Levels before the first complete breath, an estimate of its depth.
    breath
        The output.
    """

    choice: SignalChoice
    seconds: float | None = None
    fast: float = 0.0
    spikes: Spikes = field(default_factory=Spikes)
    bins: Bins = field(default_factory=Bins)
    turns: TurningPoints = field(default_factory=TurningPoints)
    track: PhaseTrack = field(default_factory=PhaseTrack)
    current: CurrentBreath = field(default_factory=CurrentBreath)
    history: BreathingHistory = field(default_factory=BreathingHistory)
    first: tuple[float, ...] = ()
    events: event_rules.Events = ()
    breath: Breath


def start_breathing(choice: SignalChoice) -> BreathingState:
    """Return the initial state for a signal."""
    return BreathingState(choice=choice, breath=Breath(signal=choice))


def with_baseline(state: BreathingState, baseline: float) -> BreathingState:
    """Set the level of the end of exhale that drift is measured from [mm; l for the volume]."""
    if not abs(baseline) <= MAX_ABS_MM:
        return state
    events = tuple(event for event in state.events if event.kind is not BreathEventKind.DRIFT)
    history = replace(state.history, learned=baseline / state.choice.per_mm, correction=0.0)
    return _with_output(replace(state, history=history, events=events))


def correct_baseline(state: BreathingState, by: float) -> BreathingState:
    """Measure drift from a level ``by`` above the learned one [mm; l for the volume]; 0 cancels the correction."""
    if not abs(by) <= MAX_ABS_MM:
        return state
    events = tuple(event for event in state.events if event.kind is not BreathEventKind.DRIFT)
    history = replace(state.history, correction=by / state.choice.per_mm)
    return _with_output(replace(state, history=history, events=events))


def shifted(state: BreathingState, by: float) -> BreathingState:
    """Shift all levels by a change of the signal's reference [mm; l for the volume]."""
    if not abs(by) <= MAX_ABS_MM:  # NaN: the signal is not measured now
        return state
    mm = by / state.choice.per_mm
    spikes, bins, turns, current = state.spikes, state.bins, state.turns, state.current
    return _with_output(
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
            current=shifted_breath(current, mm),
            history=histories.shifted_history(state.history, mm),
        )
    )


def lose_breathing(state: BreathingState) -> BreathingState:
    """Handle a frame without a value: the output is empty, the state is kept."""
    return replace(state, breath=Breath(signal=state.choice, note=NOT_MEASURED))


def follow_breathing(state: BreathingState, seconds: float, value: float) -> BreathingState:
    """Add a frame's value.

    Parameters
    ----------
    seconds
        Device time of the frame [s].
    value
        The signal [mm; l for the volume], inhale positive, any offset; NaN if it was not measured.
    """
    mm = value / state.choice.per_mm
    if not (abs(seconds) < MAX_S and abs(mm) <= MAX_ABS_MM):  # also for NaN
        return lose_breathing(state)
    if state.seconds is None or seconds < state.seconds:
        return _started(state, seconds, mm)
    if seconds == state.seconds:
        return state
    if seconds - state.seconds > GAP_S:
        return _after_gap(state, seconds, mm)
    return _with_output(_continued(state, state.seconds, seconds, mm))


def _continued(state: BreathingState, before_s: float, seconds: float, mm: float) -> BreathingState:
    """Add the next value of a signal without a gap."""
    fast = state.fast + (1.0 - math.exp((before_s - seconds) / SMOOTHING_S)) * (mm - state.fast)
    rise = state.history.rise
    spikes = follow_spikes(state.spikes, seconds, mm, rise)
    bins, is_closed = follow_bins(state.bins, seconds, mm, rise)
    is_coughing = spikes.is_cough(seconds)
    if is_coughing or event_rules.find_event(state.events, BreathEventKind.COUGH) is not None:
        state = _during_cough(replace(state, seconds=seconds, fast=fast, spikes=spikes, bins=bins), seconds)
        return _at_closed_bin(state, seconds)
    turns, has_turned = follow_turns(state.turns, seconds, fast, _threshold(state, seconds))
    track, habit, was = state.track, state.history.habit, state.turns.direction
    if habit is not None and not has_turned:
        track = advance(track, habit, seconds)
    state = replace(state, seconds=seconds, fast=fast, spikes=spikes, bins=bins, turns=turns, track=track)
    if has_turned:
        state = _at_turning_point(state, seconds, was)
    return _checked(_at_closed_bin(state, seconds) if is_closed else state, seconds)


def _checked(state: BreathingState, seconds: float) -> BreathingState:
    """Suspend the phase until the next consistent breath if the level contradicts it."""
    history, track, habit = state.history, state.track, state.history.habit
    if habit is None or history.breaths_needed > 0 or not math.isfinite(track.reported):
        return state
    moment = ExpectedPosition(track.percent, track.late > 0.0, history.low, seconds, state.fast)
    if not contradicts_phase(moment, habit, state.turns, state.current):
        return state
    return replace(state, history=suspending(history, 1, ELSEWHERE))


def _with_output(state: BreathingState) -> BreathingState:
    low = state.current.low
    return replace(state, breath=breath_of(state.choice, state.history, state.track, state.events, low))


def _started(state: BreathingState, seconds: float, mm: float) -> BreathingState:
    """Restart with this value; the learned end of exhale is kept, as the patient is the same."""
    fresh = replace(
        start_breathing(state.choice),
        history=BreathingHistory(learned=state.history.learned, correction=state.history.correction),
        seconds=seconds,
        fast=mm,
    )
    return replace(fresh, spikes=follow_spikes(fresh.spikes, seconds, mm, 0.0))


def _after_gap(state: BreathingState, seconds: float, mm: float) -> BreathingState:
    """Continue after a gap: the usual breath is kept, the phase has to be found again."""
    usual = replace(Spikes(), usual=state.spikes.usual, since_s=state.spikes.since_s)
    drift_events = tuple(event for event in state.events if event.kind is BreathEventKind.DRIFT)
    history = replace(suspending(state.history, INITIAL_BREATHS, AFTER_GAP), watched_s=None, quick=0)
    state = replace(
        _without_current_breath(state, seconds),
        seconds=seconds,
        fast=mm,
        bins=Bins(),
        events=drift_events,
        history=history,
    )
    return _with_output(replace(state, spikes=follow_spikes(usual, seconds, mm, state.history.rise)))


def _without_current_breath(state: BreathingState, seconds: float) -> BreathingState:
    """Discard the current breath."""
    return replace(state, turns=TurningPoints(turned_s=seconds), current=CurrentBreath(), track=PhaseTrack())


def _during_cough(state: BreathingState, seconds: float) -> BreathingState:
    """Suspend turning points during a cough, and undo breaths that its first spikes have caused."""
    history = suspending(state.history, 1, COUGH)
    history = histories.truncated(history, state.spikes.first_s - 2.0 * SMOOTHING_S)
    history = replace(history, disturbed_s=seconds, watched_s=None)
    return replace(_without_current_breath(state, seconds), history=history)


def _threshold(state: BreathingState, seconds: float) -> float:
    """Distance by which the signal must leave an extreme for a turning point [mm]."""
    habit = state.history.habit
    if habit is None:
        reach = max(state.first) - min(state.first) if state.first else 0.0
        return max(MIN_TURN_MM, FIRST_TURN_SHARE * reach)
    late = (seconds - state.turns.turned_s) / habit.period_s - TURN_DECAY_AFTER
    share = TURN_SHARE * (math.exp(-late) if late > 0.0 else 1.0)  # breathing may have become shallow
    return max(MIN_TURN_MM, share * habit.rise)


def _at_turning_point(state: BreathingState, seconds: float, was: int) -> BreathingState:
    """Process a turning point: an end of exhale, or an end of inhale, which completes a breath."""
    turns, history = state.turns, state.history
    # The smoothed signal lags by its time constant.
    timely = replace(turns, high_s=turns.high_s - SMOOTHING_S, low_s=turns.low_s - SMOOTHING_S)
    current, cycle = with_turn(state.current, timely, seconds)
    if was == UNKNOWN and turns.direction == FALLING:
        return replace(state, current=CurrentBreath())  # a signal that starts during an exhale has no end of inhale
    if turns.direction == RISING:
        history = histories.with_low(history, timely.low_s, state.current.low if was != UNKNOWN else math.nan)
    else:
        history = histories.with_inhale(history, seconds, state.current.speed, turns.high - state.current.trough)
        history = history if cycle is None else histories.with_breath(history, cycle)
    track = state.track
    if history.habit is not None:
        track = synchronise(track, history.habit, seconds, timely.high_s, turns.direction)
    return replace(state, current=current, history=history, track=track)


# -- ten times a second -----------------------------------------------------------------------------------------


def _at_closed_bin(state: BreathingState, seconds: float) -> BreathingState:
    """Update current breath, history and events at a closed bin."""
    bins, history = state.bins, histories.timed(state.history, seconds)
    current = with_bin(state.current, bins.level if bins.is_level_known else None, bins.speed, (seconds, state.fast))
    first = (*state.first, bins.short_level)[-FIRST_BINS:] if history.habit is None and bins.values else ()
    events = event_rules.update_events(state.events, _indicators(state, history, seconds), history.habit)
    for event in events:
        if event.kind in NO_PHASE:
            history = suspending(history, *NO_PHASE[event.kind])
    is_held = history.habit is not None and _is_held(state, history, history.habit, seconds)
    if is_held:
        history = suspending(history, 1, HELD)
    if is_held or any(event.kind in DISTURBING for event in events):
        history = replace(history, disturbed_s=seconds)
    return replace(state, current=current, first=first, events=events, history=history)


def _is_held(state: BreathingState, history: BreathingHistory, habit: BreathingHabit, seconds: float) -> bool:
    """Whether the breath is held above the end of exhale."""
    is_still = seconds - state.bins.still_s > event_rules.still_enough_s(habit)
    return is_still and state.bins.still_at - history.low > event_rules.LOW_SHARE * habit.rise


def _indicators(state: BreathingState, history: BreathingHistory, seconds: float) -> event_rules.Indicators:
    spikes, bins = state.spikes, state.bins
    return event_rules.Indicators(
        now_s=seconds,
        height=bins.short_level - history.low,
        still_s=seconds - bins.still_s,
        still_height=bins.still_at - history.low,
        lost_s=seconds - max(state.turns.turned_s, history.disturbed_s),
        is_cough=spikes.is_cough(seconds),
        cough_s=spikes.first_s,
        cough_bends=spikes.bends,
        quick=history.quick,
        quick_s=history.quick_s,
        regularity=history.regularity,
        drifts=_drifts(state, history),
        scatter=history.scatter,
    )


def _drifts(state: BreathingState, history: BreathingHistory) -> tuple[float, float] | None:
    """Distance of the last two ends of exhale from the expected level [mm]; a lower current one counts as the last."""
    expected = history.expected
    if expected is None or len(history.lows) < 2 or history.lows[-2][0] < history.disturbed_s:
        return None
    before, last = (low - expected for _, low in history.lows[-2:])
    now = state.current.low - expected
    return (last, now) if state.turns.direction == FALLING and now < min(last, 0.0) else (before, last)
