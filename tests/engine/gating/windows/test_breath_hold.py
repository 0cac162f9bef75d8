"""A breath that is held: reached, still, not drifting, not for too long; and counted."""

import math
from dataclasses import replace

import pytest

from engine.core.breath import WHOLE, Breath, BreathEvent, BreathEventKind
from engine.core.commands import Arm, Disarm
from engine.core.errors import InvalidValueError
from engine.core.gate_state import GateState, HoldReason
from engine.core.signals import LearnedRange
from engine.gating.windows import LEVEL_NOT_SET, AmplitudeWindow, BreathHoldWindow, HoldStage, JoinedWindow
from engine.gating.windows.conditions import ConditionState, WindowInput, WindowVerdict
from tests.support.gating.bad_frames import HOLDS
from tests.support.gating.streams import A_BREATH_FRAMES, LIMITS, Stream, motion_of, unmeasured

LEVEL = AmplitudeWindow(lower=18.0, upper=24.0, hysteresis=0.5)
WINDOW = BreathHoldWindow(level=LEVEL, settle_ms=500.0, still=0.6, max_drift=1.5, timeout_s=3.0)
HOLD_LIMITS = replace(LIMITS, window=WINDOW, max_jump_mm=20.0)
SETTLE_FRAMES = 16
"""The first frame still, and fifteen periods of 33.4 ms after it: half a second."""
DWELL_FRAMES = 4


def armed(level_mm: float = 6.0) -> Stream:
    stream = Stream(HOLD_LIMITS, level_mm)
    stream.good(2)
    stream.step(Arm(operator="ann"))
    return stream


def held(level_mm: float = 21.0) -> Stream:
    """A beam that is on in a breath hold, by nothing but frames."""
    stream = armed()
    stream.level_mm = level_mm
    stream.good(SETTLE_FRAMES + DWELL_FRAMES)
    assert stream.gate.state is GateState.BEAM_ON
    return stream


def breathe(stream: Stream) -> None:
    stream.level_mm = 6.0
    stream.good(A_BREATH_FRAMES)


def test_free_breathing_waits_for_the_hold():
    gate = armed().feed()
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.BREATH_HOLD_AWAITED)


def test_a_hold_has_to_be_still_for_the_settle_time_and_then_for_the_dwell():
    stream = armed()
    stream.level_mm = 21.0
    states = stream.good(SETTLE_FRAMES - 1)
    assert set(states) == {GateState.HOLD}
    assert stream.gate.reason is HoldReason.BREATH_HOLD_SETTLING
    assert stream.good(DWELL_FRAMES) == [GateState.DWELL] * (DWELL_FRAMES - 1) + [GateState.BEAM_ON]


def test_a_breath_that_passes_the_level_is_no_hold():
    stream = armed()
    for frame in range(60):  # 18.2 to 23.8 mm and back, never still for half a second
        stream.level_mm = 21.0 + 2.8 * math.sin(0.25 * frame)
        assert stream.feed().state is GateState.HOLD
    assert stream.gate.breath_holds == 0


def test_settling_begins_anew_when_it_moves():
    stream = armed()
    stream.level_mm = 20.0
    stream.good(SETTLE_FRAMES - 1)
    stream.level_mm = 20.7
    assert stream.feed().reason is HoldReason.BREATH_HOLD_SETTLING
    assert set(stream.good(SETTLE_FRAMES - 2)) == {GateState.HOLD}
    assert stream.feed().state is GateState.DWELL


def test_the_hold_ends_on_drift_at_once_and_the_next_needs_a_breath():
    stream = held(20.0)
    stream.level_mm = 21.5
    assert stream.feed().state is GateState.BEAM_ON  # the bound itself is allowed
    stream.level_mm = 21.51
    gate = stream.feed()
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.BREATH_HOLD_DRIFTED)
    assert set(stream.good(60)) == {GateState.HOLD}
    assert stream.gate.reason is HoldReason.BREATH_HOLD_DRIFTED
    breathe(stream)
    assert stream.gate.reason is HoldReason.BREATH_HOLD_AWAITED
    stream.level_mm = 21.5
    assert stream.good(SETTLE_FRAMES + DWELL_FRAMES)[-1] is GateState.BEAM_ON
    assert stream.gate.breath_holds == 2


def test_a_hold_that_drifted_and_came_back_is_no_hold_before_a_breath():
    stream = held(20.0)
    stream.level_mm = 21.51
    stream.feed()
    stream.level_mm = 20.0
    assert set(stream.good(3 * SETTLE_FRAMES)) == {GateState.HOLD}
    assert stream.gate.reason is HoldReason.BREATH_HOLD_DRIFTED


@pytest.mark.parametrize("step_mm", [0.05, -0.05])
def test_a_level_that_creeps_is_never_still(step_mm):
    """Each step is small; from the first frame that settles to the last they are more than ``still``."""
    stream = armed()
    stream.level_mm = 21.0 - 25 * step_mm
    for _ in range(50):
        stream.level_mm += step_mm
        assert stream.feed().state is GateState.HOLD
    assert stream.gate.breath_holds == 0


def test_drift_counts_from_where_it_settled_in_both_directions():
    stream = held(21.0)
    stream.level_mm = 19.49
    assert stream.feed().reason is HoldReason.BREATH_HOLD_DRIFTED


def test_the_hold_times_out_and_the_next_needs_a_breath():
    stream = held()
    states = stream.good(100)
    on = states.index(GateState.HOLD)
    assert 80 <= on + DWELL_FRAMES <= 92  # three seconds at 29.97 frames a second
    assert stream.gate.reason is HoldReason.BREATH_HOLD_OVER
    assert set(states[on:]) == {GateState.HOLD}
    breathe(stream)
    stream.level_mm = 21.0
    assert stream.good(SETTLE_FRAMES + DWELL_FRAMES)[-1] is GateState.BEAM_ON


def test_leaving_the_level_ends_the_hold_at_once_at_the_edge_itself():
    stream = held(18.6)
    stream.level_mm = 18.0
    assert stream.feed().state is GateState.BEAM_ON
    stream.level_mm = 17.99
    gate = stream.feed()
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.BREATH_HOLD_AWAITED)


def test_the_level_is_entered_only_by_the_hysteresis():
    stream = armed()
    stream.level_mm = 18.49
    assert stream.feed().reason is HoldReason.BREATH_HOLD_AWAITED
    stream.level_mm = 18.5
    assert stream.feed().reason is HoldReason.BREATH_HOLD_SETTLING


@pytest.mark.parametrize("name", sorted(HOLDS.keys() - {"above the window"}))
def test_any_bad_frame_costs_a_whole_settling_and_a_full_dwell(name):
    spoil, _reason = HOLDS[name]
    stream = held()
    frame = spoil(stream.upcoming())
    assert stream.feed(frame).state is GateState.HOLD
    assert GateState.BEAM_ON not in stream.good(SETTLE_FRAMES + DWELL_FRAMES - 2)
    assert stream.good(3)[-1] is GateState.BEAM_ON


def test_a_bad_frame_does_not_pass_for_the_breath_that_is_due():
    stream = held()
    stream.level_mm = 22.6
    assert stream.feed().reason is HoldReason.BREATH_HOLD_DRIFTED
    spoil, _ = HOLDS["marker lost"]
    stream.feed(spoil(stream.upcoming()))
    assert GateState.BEAM_ON not in stream.good(3 * SETTLE_FRAMES)
    assert stream.gate.reason is HoldReason.BREATH_HOLD_DRIFTED


def test_lost_frames_do_not_make_a_longer_hold_of_it():
    stream = held()
    spoil, _ = HOLDS["marker lost"]
    on = 0
    for _ in range(8):  # a frame is lost after every second and a half, for twelve seconds
        on += stream.good(44).count(GateState.BEAM_ON)
        stream.feed(spoil(stream.upcoming()))
    assert on < 90  # three seconds are ninety frames
    assert stream.gate.reason is not None
    assert stream.gate.breath_holds == 1


def test_a_hold_that_was_not_seen_for_a_moment_still_may_not_drift_from_where_it_settled():
    stream = held(20.0)
    spoil, _ = HOLDS["marker lost"]
    for level_mm in (20.5, 21.0, 21.4, 21.8):
        stream.feed(spoil(stream.upcoming()))
        stream.level_mm = level_mm
        stream.good(SETTLE_FRAMES + 1)
    assert stream.gate.reason is HoldReason.BREATH_HOLD_DRIFTED


def test_arming_counts_anew_and_a_hold_keeps_its_level_and_its_time():
    stream = held()
    breathe(stream)
    stream.level_mm = 21.0
    stream.good(SETTLE_FRAMES + 20)
    assert stream.gate.breath_holds == 2
    before = stream.gate.conditions[0]
    stream.step(Disarm(operator="ann"))
    stream.step(Arm(operator="ann"))
    after = stream.gate.conditions[0]
    assert (after.stage, after.settled_at, after.held_since_us) == (
        HoldStage.AWAITED,
        before.settled_at,
        before.held_since_us,
    )
    assert stream.gate.breath_holds == 1
    stream.good(SETTLE_FRAMES + DWELL_FRAMES)
    assert stream.gate.breath_holds == 1
    assert stream.good(90)[-1] is GateState.HOLD
    assert stream.gate.reason is HoldReason.BREATH_HOLD_OVER
    stream.step(Disarm(operator="ann"))
    stream.step(Arm(operator="ann"))
    assert stream.gate.breath_holds == 0
    assert GateState.BEAM_ON not in stream.good(60)
    breathe(stream)
    stream.level_mm = 21.0
    assert stream.good(SETTLE_FRAMES + DWELL_FRAMES)[-1] is GateState.BEAM_ON


def test_an_expiration_hold_is_the_same_at_the_other_end():
    window = BreathHoldWindow(
        level=AmplitudeWindow(lower=-2.0, upper=1.0), kind="expiration", settle_ms=500.0, still=0.6, max_drift=1.5
    )
    stream = Stream(replace(LIMITS, window=window, max_jump_mm=20.0), 8.0)
    stream.good(2)
    stream.step(Arm(operator="ann"))
    assert stream.feed().reason is HoldReason.BREATH_HOLD_AWAITED
    stream.level_mm = -0.5
    assert stream.good(SETTLE_FRAMES + DWELL_FRAMES)[-1] is GateState.BEAM_ON


def test_a_frame_that_was_not_measured_is_no_level():
    stream = held()
    frame = stream.upcoming()
    assert stream.feed(unmeasured(frame, frame.state.TRAINING)).state is GateState.HOLD


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("settle_ms", 99.0),
        ("settle_ms", 10_001.0),
        ("still", 0.0),
        ("max_drift", math.nan),
        ("max_drift", 21.0),
        ("timeout_s", 0.9),
        ("timeout_s", 121.0),
        ("timeout_s", True),
        ("kind", "middle"),
    ],
)
def test_a_hold_that_is_none_is_refused_by_field_and_bound(field, value):
    with pytest.raises(InvalidValueError) as refusal:
        replace(WINDOW, **{field: value})
    assert refusal.value.field == field
    assert refusal.value.bound


# -- one frame at a time ----------------------------------------------------------------------------------------------

FIRST_US = 40_000_000


def judged(level_mm: float, at_ms: float, state: ConditionState) -> WindowVerdict:
    """Judge a frame of this level, so long after the first."""
    motion = motion_of(level_mm)
    return WINDOW.judge(WindowInput(motion=motion, breaths=(), timestamp_us=FIRST_US + round(1e3 * at_ms)), (state,))


def settling(lowest: float = 21.0, highest: float = 21.0) -> ConditionState:
    return ConditionState(stage=HoldStage.SETTLING, since_us=FIRST_US, lowest=lowest, highest=highest)


def being_held() -> ConditionState:
    return ConditionState(
        stage=HoldStage.HELD,
        since_us=FIRST_US,
        lowest=21.0,
        highest=21.0,
        settled_at=21.0,
        held_since_us=FIRST_US,
        timeout_s=3.0,
        holds=1,
    )


def test_the_first_frame_inside_begins_to_settle():
    found = judged(21.0, 0.0, ConditionState(since_us=5, lowest=1.0, highest=30.0))
    assert found.states == (settling(),)
    assert (found.is_inside, found.reason) == (False, HoldReason.BREATH_HOLD_SETTLING)
    assert found.detail == "still for 0.0 s; 0.5 s needed"


def test_extremes_are_kept_while_it_settles_and_begin_with_the_frame_that_moves_too_far():
    for level_mm, extremes in (
        (21.3, (21.0, 21.3)),
        (20.7, (20.7, 21.0)),
        (21.59, (21.0, 21.59)),
        (20.41, (20.41, 21.0)),
    ):
        assert judged(level_mm, 100.0, settling()).states == (settling(*extremes),)
    for level_mm in (21.61, 20.39):
        found = judged(level_mm, 100.0, settling())
        assert found.states == (replace(settling(level_mm, level_mm), since_us=FIRST_US + 100_000),)
        assert (found.reason, found.detail) == (HoldReason.BREATH_HOLD_SETTLING, "the signal moves; 0.5 s needed")


def test_a_range_that_equals_the_bound_is_still():
    window = replace(WINDOW, still=0.5)
    seen = WindowInput(motion=motion_of(21.5), breaths=(), timestamp_us=FIRST_US + 500_000)
    assert window.judge(seen, (settling(),)).is_inside


def test_it_is_held_from_the_settle_time_itself():
    before = judged(21.0, 499.999, settling())
    assert (before.is_inside, before.detail) == (False, "still for 0.5 s; 0.5 s needed")
    found = judged(21.2, 500.0, settling())
    then_us = FIRST_US + 500_000
    assert found.is_inside
    held = replace(being_held(), since_us=then_us, held_since_us=then_us, highest=21.2, settled_at=21.2)
    assert found.states == (held,)


def test_a_held_frame_changes_nothing():
    assert judged(21.4, 700.0, being_held()) == WindowVerdict(is_inside=True, states=(being_held(),))


def test_it_is_over_at_the_time_limit_itself():
    assert judged(21.0, 2_999.999, being_held()).is_inside
    found = judged(21.0, 3_000.0, being_held())
    assert (found.is_inside, found.reason, found.detail) == (False, HoldReason.BREATH_HOLD_OVER, "held for 3 s")
    assert found.states == (replace(being_held(), stage=HoldStage.OVER, since_us=FIRST_US + 3_000_000),)


def test_its_stage_states_that_it_drifted_and_when():
    found = judged(22.51, 800.0, being_held())
    assert (found.is_inside, found.reason) == (False, HoldReason.BREATH_HOLD_DRIFTED)
    assert found.detail == "1.5 mm from the settled level, 1.5 allowed"
    assert found.states == (replace(being_held(), stage=HoldStage.DRIFTED, since_us=FIRST_US + 800_000),)


def test_a_level_in_per_cent_waits_for_the_range_not_for_a_breath():
    window = replace(WINDOW, level=AmplitudeWindow(lower=60.0, upper=90.0, unit="percent"))
    seen = WindowInput(motion=motion_of(21.0), breaths=(), timestamp_us=FIRST_US)
    assert window.judge(seen, (ConditionState(),)).reason is HoldReason.RANGE_UNKNOWN


def test_a_level_that_is_not_set_is_met_by_no_signal_and_by_no_range():
    unset = replace(WINDOW, level=AmplitudeWindow(lower=0.0, upper=100.0, unit="percent"), is_level_set=False)
    learned = {WHOLE: LearnedRange(low=0.0, high=21.0)}
    assert unset.resolved(learned) == unset
    assert unset.needs_ranges
    found = unset.judge(WindowInput(motion=motion_of(10.0), breaths=(), timestamp_us=FIRST_US), (ConditionState(),))
    assert (found.is_inside, found.reason) == (False, HoldReason.RANGE_UNKNOWN)
    assert found.detail == LEVEL_NOT_SET
    with pytest.raises(InvalidValueError, match="true for a level in mm"):
        replace(WINDOW, is_level_set=False)


APNOEA = (
    Breath(events=(BreathEvent(kind=BreathEventKind.APNOEA, start_us=0, confidence=1.0, detail="no breath for 12 s"),)),
)
BESIDE = AmplitudeWindow(lower=4.0, upper=8.0)


def in_apnoea(stream: Stream, frames: int) -> list[GateState]:
    return [stream.feed(replace(stream.upcoming(), breaths=APNOEA)).state for _ in range(frames)]


@pytest.mark.parametrize("join", ["and", "or", None])
def test_ceased_breathing_is_excused_in_a_breath_that_is_held(join):
    window = (
        WINDOW if join is None else JoinedWindow(conditions=(WINDOW, AmplitudeWindow(lower=0.0, upper=30.0)), join=join)
    )
    window = replace(window, conditions=(WINDOW, BESIDE)) if join == "or" else window
    stream = Stream(replace(HOLD_LIMITS, window=window), 6.0)
    stream.good(2)
    stream.step(Arm(operator="ann"))
    stream.level_mm = 21.0
    assert in_apnoea(stream, SETTLE_FRAMES + DWELL_FRAMES)[-1] is GateState.BEAM_ON


def test_a_held_breath_that_was_not_seen_for_a_moment_in_apnoea_is_held_again():
    stream = held()
    in_apnoea(stream, 2)
    spoil, _ = HOLDS["marker lost"]
    stream.feed(replace(spoil(stream.upcoming()), breaths=APNOEA))
    assert in_apnoea(stream, SETTLE_FRAMES + DWELL_FRAMES)[-1] is GateState.BEAM_ON


def test_ceased_breathing_in_the_other_way_into_the_beam_is_not_excused():
    """An amplitude joined by or with a hold: the kind of the window excuses nothing, only a breath that is held."""
    window = JoinedWindow(conditions=(WINDOW, BESIDE), join="or")
    stream = Stream(replace(HOLD_LIMITS, window=window), 6.0)
    stream.good(2)
    stream.step(Arm(operator="ann"))
    assert stream.good(6)[-1] is GateState.BEAM_ON
    assert set(in_apnoea(stream, 30)) == {GateState.HOLD}
    assert stream.gate.reason is HoldReason.BREATHING_IRREGULAR


def test_events_that_no_breath_hold_resembles_hold_in_it_too():
    stream = Stream(replace(HOLD_LIMITS, holding_events=frozenset({BreathEventKind.COUGH})), 21.0)
    stream.good(2)
    stream.step(Arm(operator="ann"))
    assert stream.good(SETTLE_FRAMES + DWELL_FRAMES)[-1] is GateState.BEAM_ON
    cough = Breath(
        events=(BreathEvent(kind=BreathEventKind.COUGH, start_us=0, confidence=1.0, detail="as the test wants it"),)
    )
    assert stream.feed(replace(stream.upcoming(), breaths=(cough,))).reason is HoldReason.BREATHING_IRREGULAR


def test_the_least_time_of_all_windows_ends_a_hold():
    stream = held()
    stream.limits = replace(HOLD_LIMITS, window=replace(WINDOW, timeout_s=60.0))
    assert stream.good(100)[-1] is GateState.HOLD
    assert stream.gate.reason is HoldReason.BREATH_HOLD_OVER
