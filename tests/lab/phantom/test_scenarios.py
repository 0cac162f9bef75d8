import math

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from engine.qa.recorded_traces import Trace
from lab.phantom.anatomy import Anatomy
from lab.phantom.breathing import Breathing
from lab.phantom.scenarios import SHORTEST_S, check_scenario, plan
from lab.phantom.truth import Skin, volume_ratio

ANATOMY = Anatomy(3)
TRACE = Trace(kind="qa", axis="z", time_s=np.arange(0.0, 40.0, 0.2), motion_mm=4 * np.sin(np.arange(0.0, 40.0, 0.2)))


def lay_out(scenario, seconds, seed=0, trace=None, anatomy=ANATOMY):
    rng = np.random.default_rng(seed)
    return plan(scenario, anatomy.build, seconds, rng, volume_ratio=volume_ratio(anatomy), trace=trace)


def during(timeline, event):
    times = timeline.signals.time_s
    return (times >= event.start_s) & (times < event.end_s)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scenario", ["isovolume", "dibh", "shift", "occlusion", "events"])
def test_free_breathing_comes_first_for_twenty_seconds(scenario, seed):
    events = lay_out(scenario, SHORTEST_S[scenario], seed).events
    assert events[0].name == "free"
    assert events[0].start_s == 0.0
    assert events[0].end_s >= 20.0
    assert all(event.end_s <= SHORTEST_S[scenario] for event in events)
    assert len(events) > 1


@pytest.mark.parametrize("seed", range(6))
def test_holds_last_ten_to_twenty_seconds_at_two_to_four_times_the_tide(seed):
    timeline = lay_out("dibh", 120.0, seed)
    holds = [event for event in timeline.events if event.name == "hold"]
    assert len(holds) >= 3
    free = during(timeline, timeline.events[0])
    signals = timeline.signals
    tide = np.ptp(signals.abdomen_mm[free]), np.ptp(signals.thorax_mm[free])
    for hold in holds:
        inside = during(timeline, hold)
        assert 10.0 <= hold.end_s - hold.start_s <= 20.0
        abdomen, thorax = signals.abdomen_mm[inside].mean(), signals.thorax_mm[inside].mean()
        assert 1.6 < abdomen / tide[0] < 2.5
        assert 2.4 < thorax / tide[1] < 4.0
        assert thorax / abdomen > 1.25 * tide[1] / tide[0]
        assert signals.abdomen_mm[inside].std() < 0.35


def test_the_isovolume_manoeuvre_moves_chest_against_belly_and_no_air():
    timeline = lay_out("isovolume", 60.0)
    inside = during(timeline, timeline.events[1])
    weights = Breathing(timeline.signals, ANATOMY.build).weights(timeline.signals.time_s)
    abdomen, thorax = weights[inside, 1], weights[inside, 4]
    assert np.corrcoef(abdomen, thorax)[0, 1] < -0.98
    assert np.ptp(abdomen) > 5.0
    volume = Skin(ANATOMY).volume_l(weights)
    free = during(timeline, timeline.events[0])
    assert np.ptp(volume[inside]) < 0.2 * np.ptp(volume[free])


@pytest.mark.parametrize("seed", range(4))
def test_the_baseline_drifts_by_three_to_five_mm(seed):
    timeline = lay_out("drift", 60.0, seed)
    still = lay_out("regular", 60.0, seed)
    moved = timeline.signals.abdomen_mm - still.signals.abdomen_mm
    at_end = moved[np.searchsorted(timeline.signals.time_s, 60.0)]
    assert 3.0 <= abs(at_end) <= 5.0
    assert np.abs(moved[timeline.signals.time_s < timeline.events[1].start_s]).max() == 0.0


@pytest.mark.parametrize("seed", range(8))
def test_the_patient_moves_by_five_to_fifteen_mm_and_turns_within_a_second(seed):
    timeline = lay_out("shift", 40.0, seed)
    move = timeline.events[1]
    before, after = timeline.pose(move.start_s - 0.001), timeline.pose(move.end_s + 0.001)
    assert (before.x_mm, before.y_mm, before.turn_rad) == (0.0, 0.0, 0.0)
    assert 5.0 <= math.hypot(after.x_mm, after.y_mm) <= 15.0
    assert 1.0 <= abs(math.degrees(after.turn_rad)) <= 2.0
    assert move.start_s >= 22.0
    assert timeline.pose(40.0) == after
    halfway = timeline.pose(0.5 * (move.start_s + move.end_s))
    assert math.hypot(halfway.x_mm, halfway.y_mm) == pytest.approx(0.5 * math.hypot(after.x_mm, after.y_mm))


def test_a_hand_comes_first_and_a_hidden_sticker_later():
    names = [event.name for event in lay_out("occlusion", 40.0).events]
    assert names == ["free", "hand", "marker_hidden"]


@pytest.mark.parametrize("scenario", SHORTEST_S)
def test_a_recording_too_short_for_its_scenario_is_refused(scenario):
    shortest = SHORTEST_S[scenario]
    check_scenario(scenario, shortest, None)
    for seconds in (shortest - 0.01, 1801.0, math.nan, math.inf, -5.0, True):
        with pytest.raises(InvalidValueError, match=f"seconds is .*: must be from {shortest:g} to 1800 for {scenario}"):
            check_scenario(scenario, seconds, None)


def test_an_unknown_scenario_is_refused_with_those_there_are():
    with pytest.raises(InvalidValueError, match=r"scenario is 'dance': must be one of regular, .*, occlusion, events"):
        check_scenario("dance", 30.0, None)


def test_a_trace_drives_belly_and_chest():
    timeline = lay_out("regular", 30.0, trace=TRACE)
    signals = timeline.signals
    inside = (signals.time_s > 0) & (signals.time_s < 30)
    assert np.abs(signals.abdomen_mm[inside] - 4 * np.sin(signals.time_s[inside])).max() < 0.05
    assert signals.thorax_mm == pytest.approx(ANATOMY.build.thorax_share * signals.abdomen_mm)


def test_a_trace_bounds_the_length_and_leaves_no_room_for_manoeuvres():
    with pytest.raises(InvalidValueError, match=r"at most 39\.8, the length of the trace"):
        check_scenario("regular", 40.0, TRACE)
    for scenario in ("dibh", "isovolume", "irregular"):
        with pytest.raises(InvalidValueError, match="with a trace one of regular, drift, shift, occlusion"):
            check_scenario(scenario, 39.0, TRACE)
