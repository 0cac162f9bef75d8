"""The breath and the breath hold on their way out: what is known with its figures, what is not as null with why."""

import json
from dataclasses import replace

from engine.core.breath import Breath, BreathEvent, BreathEventKind, SignalChoice
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, ConditionState, HoldStage, JoinedWindow
from service.sessions.views.breath import live_breath, live_breath_hold
from tests.support.service.fake_engine import FakeRunning

THORAX = SignalChoice(signal="thorax")
HOLD = BreathHoldWindow(level=AmplitudeWindow(lower=8.0, upper=12.0), settle_ms=1_500.0, timeout_s=20.0)


def view_of(**options):
    running = FakeRunning(None)
    for name, value in options.items():
        setattr(running, name, value)
    for _ in range(31):
        running.frame()
    return running.latest


def test_the_reported_breath_is_that_of_the_first_gated_signal():
    breaths = (Breath(signal=THORAX, rate_per_min=9.0), Breath(rate_per_min=14.0))
    assert live_breath(view_of(breaths=breaths)).rate_per_min == 14.0
    assert live_breath(view_of(breaths=breaths[:1])) is None
    assert live_breath(view_of()) is None


def test_what_is_not_known_is_null_and_states_why():
    reported = live_breath(view_of(breaths=(Breath(note="too little seen yet", drift=float("nan")),)))
    assert (reported.phase_percent, reported.note, reported.drift, reported.rate_per_min) == (
        None,
        "too little seen yet",
        None,
        None,
    )
    known = live_breath(view_of(breaths=(Breath(phase_percent=12.34567, note="stays"),)))
    assert (known.phase_percent, known.note) == (12.3457, "")
    assert "NaN" not in json.dumps(reported.model_dump())


def test_events_say_since_when_they_are_under_way():
    at_us = 30 * 33_370
    event = BreathEvent(kind=BreathEventKind.APNOEA, start_us=at_us - 2_500_000, confidence=0.81, detail="x")
    (reported,) = live_breath(view_of(breaths=(Breath(events=(event,)),))).events
    assert (reported.kind, reported.since_s, reported.confidence, reported.detail) == ("apnoea", 2.5, 0.81, "x")


def test_a_breath_that_is_held_as_prescribed_is_no_sigh_and_no_apnoea():
    events = tuple(BreathEvent(kind=kind, start_us=0, confidence=1.0, detail="x") for kind in BreathEventKind)
    held = live_breath(view_of(window=HOLD, breaths=(Breath(events=events),)))
    assert {one.kind for one in held.events} == {"cough", "talking", "drift"}
    free = live_breath(view_of(breaths=(Breath(events=events),)))
    assert len(free.events) == len(BreathEventKind)


def test_a_breath_hold_reports_its_stage_its_seconds_and_how_many_there_were():
    at_us = 30 * 33_370
    state = ConditionState(stage=HoldStage.HELD, since_us=at_us - 4_250_000, holds=3)
    reported = live_breath_hold(view_of(window=HOLD, conditions=(state,)))
    assert reported.model_dump() == {
        "hold": "inspiration",
        "stage": "held",
        "count": 3,
        "seconds": 4.25,
        "settle_s": 1.5,
        "timeout_s": 20.0,
    }


def test_no_countdown_while_a_hold_is_awaited_and_none_without_a_breath_hold():
    assert live_breath_hold(view_of(window=HOLD, conditions=(ConditionState(),))).seconds is None
    assert live_breath_hold(view_of()) is None


def test_a_breath_hold_is_found_behind_another_condition_even_before_the_first_judgement():
    window = JoinedWindow(conditions=(AmplitudeWindow(lower=-1.0, upper=3.0), HOLD))
    states = (ConditionState(), ConditionState(stage=HoldStage.SETTLING, since_us=30 * 33_370))
    assert live_breath_hold(view_of(window=window, conditions=states)).stage == "settling"
    view = view_of(window=window, conditions=states)
    assert live_breath_hold(replace(view, conditions=())).stage == "awaited"
