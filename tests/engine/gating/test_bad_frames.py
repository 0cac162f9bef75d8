"""Each way a frame can be bad: it holds at that frame, with its reason, and it costs a full dwell or a named person."""

from dataclasses import replace

import pytest

from engine.core.breath import Breath, BreathEvent, BreathEventKind
from engine.core.commands import Acknowledge, Arm, Disarm
from engine.core.frames import Lost, LostReason, MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.frame_checks import captured_ns
from engine.gating.gate import Interruption, Silence
from engine.gating.windows import BreathHoldWindow, JoinedWindow, amplitude_window
from tests.support.gating.bad_frames import FAULTS, HOLDS
from tests.support.gating.streams import (
    A_BREATH_FRAMES,
    FRAMES_A_DWELL,
    LEVEL_MM,
    LIMITS,
    MS,
    PERIOD_NS,
    Stream,
    clear_and_arm,
    motion_of,
    stream_in,
    unmeasured,
)

DWELL_THEN_ON = [GateState.DWELL] * (FRAMES_A_DWELL - 1) + [GateState.BEAM_ON]
ARMED = [GateState.HOLD, GateState.DWELL, GateState.BEAM_ON]


@pytest.mark.parametrize("state", ARMED, ids=str)
@pytest.mark.parametrize(("spoil", "reason"), HOLDS.values(), ids=HOLDS)
def test_a_bad_frame_holds_at_once_and_costs_a_full_dwell(state, spoil, reason):
    stream = stream_in(state)
    gate = stream.feed(spoil(stream.upcoming()))
    assert (gate.state, gate.reason) == (GateState.HOLD, reason)
    assert stream.good(FRAMES_A_DWELL) == DWELL_THEN_ON


@pytest.mark.parametrize("state", [*ARMED, GateState.DISARMED], ids=str)
@pytest.mark.parametrize(("spoil", "reason"), FAULTS.values(), ids=FAULTS)
def test_a_frame_that_cannot_be_faults_at_once_and_stays_so_whatever_comes(state, spoil, reason):
    stream = stream_in(state)
    gate = stream.feed(spoil(stream.upcoming()))
    assert (gate.state, gate.reason) == (GateState.FAULT, reason)
    stream.step(Arm(operator="ann"))
    stream.step(Disarm(operator="ann"))
    assert stream.good(20) == [GateState.FAULT] * 20


@pytest.mark.parametrize(("spoil", "_reason"), FAULTS.values(), ids=FAULTS)
def test_after_a_fault_a_person_must_acknowledge_and_arm_and_the_dwell_is_full(spoil, _reason):
    stream = stream_in(GateState.BEAM_ON)
    stream.feed(spoil(stream.upcoming()))
    stream.good(2)
    assert stream.step(Acknowledge(operator="bob")).state is GateState.DISARMED
    assert stream.good(8) == [GateState.DISARMED] * 8
    assert stream.step(Arm(operator="bob")).state is GateState.HOLD
    assert stream.good(FRAMES_A_DWELL) == DWELL_THEN_ON


def test_a_signal_below_the_window_holds():
    stream = stream_in(GateState.BEAM_ON, level_mm=0.0)
    gate = stream.feed(replace(stream.upcoming(), motion=motion_of(-1.01)))
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.OUTSIDE_WINDOW)
    assert stream.good(FRAMES_A_DWELL) == DWELL_THEN_ON


def test_a_step_larger_than_allowed_holds_even_inside_the_window():
    stream = stream_in(GateState.BEAM_ON)
    stream.level_mm = 0.49
    gate = stream.feed()
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.JUMP)
    assert stream.good(FRAMES_A_DWELL) == DWELL_THEN_ON


def test_the_largest_allowed_step_is_no_jump():
    stream = stream_in(GateState.BEAM_ON)
    stream.level_mm = 0.5
    assert stream.feed().state is GateState.BEAM_ON


@pytest.mark.parametrize(("lost_frames", "is_jump"), [(0, True), (1, False)])
def test_the_allowed_step_grows_with_the_frames_that_went_unmeasured(lost_frames, is_jump):
    stream = stream_in(GateState.HOLD)
    for _ in range(lost_frames):
        stream.feed(unmeasured(stream.upcoming(), MeasurementState.TRAINING))
    stream.level_mm = -0.5
    assert (stream.feed().reason is HoldReason.JUMP) is is_jump


@pytest.mark.parametrize("lost_frames", [4, 5, 20, 90])
def test_a_long_loss_excuses_a_step_of_five_frames_and_never_more(lost_frames):
    limits = replace(LIMITS, window=replace(LIMITS.window, upper=30.0))
    for step_mm, is_jump in [(5 * 1.5, False), (5 * 1.5 + 0.1, True)]:
        stream = stream_in(GateState.HOLD, limits=limits)
        for _ in range(lost_frames):
            stream.feed(unmeasured(stream.upcoming(), MeasurementState.TRAINING))
        stream.level_mm += step_mm
        assert (stream.feed().reason is HoldReason.JUMP) is is_jump


@pytest.mark.parametrize(
    ("age_ns", "state", "reason"),
    [
        (60 * MS, GateState.BEAM_ON, None),
        (60 * MS + 1, GateState.HOLD, HoldReason.FRAME_LATE),
        (500 * MS, GateState.HOLD, HoldReason.FRAME_LATE),
        (500 * MS + 1, GateState.FAULT, HoldReason.FRAME_STALE),
        (-1, GateState.FAULT, HoldReason.CLOCK_BACKWARDS),
    ],
)
def test_a_decision_needs_a_fresh_frame(age_ns, state, reason):
    limits = replace(LIMITS, lease_ms=200.0)
    gate = stream_in(GateState.BEAM_ON, limits=limits).feed(age_ns=age_ns)
    assert (gate.state, gate.reason) == (state, reason)


@pytest.mark.parametrize(("age_ns", "is_on"), [(80 * MS - PERIOD_NS - 1, True), (80 * MS - PERIOD_NS, False)])
def test_a_line_whose_lease_has_lapsed_goes_on_after_a_dwell_and_a_time_off_like_any_other(age_ns, is_on):
    stream = stream_in(GateState.BEAM_ON, limits=replace(LIMITS, min_off_ms=400.0))
    gate = stream.feed(age_ns=age_ns)
    assert (gate.state is GateState.BEAM_ON) is is_on
    if not is_on:
        assert gate.reason is HoldReason.FRAME_LATE
        assert GateState.BEAM_ON not in stream.good(11)  # 400 ms are twelve periods
        assert stream.good(3)[-1] is GateState.BEAM_ON


def test_a_late_decision_costs_a_full_dwell():
    stream = stream_in(GateState.BEAM_ON)
    stream.feed(age_ns=61 * MS)
    assert stream.good(FRAMES_A_DWELL) == DWELL_THEN_ON


def test_a_backlog_in_the_driver_holds_though_each_frame_arrives_fresh():
    stream = stream_in(GateState.BEAM_ON)
    slower_ns, states = 7 * MS, []
    for behind in range(1, 20):
        frame = stream.upcoming()
        states.append(stream.feed(replace(frame, received_ns=frame.received_ns + behind * slower_ns)))
    assert [gate.state for gate in states[:13]] == [GateState.BEAM_ON] * 13
    assert {(gate.state, gate.reason) for gate in states[13:]} == {(GateState.HOLD, HoldReason.FRAME_LATE)}


def test_a_device_clock_that_drifts_as_quartz_does_holds_nothing():
    stream, in_time = stream_in(GateState.BEAM_ON), {None, HoldReason.OUTSIDE_WINDOW, HoldReason.DWELL}
    for frame_number in range(40_000):  # 22 minutes, 0.01 % slow: 133 ms in the end
        stream.level_mm = 3.3 if frame_number % 150 < A_BREATH_FRAMES else LEVEL_MM
        frame = stream.upcoming()
        received_ns = frame.received_ns + int(1e-4 * frame_number * PERIOD_NS)
        fresh = replace(frame, received_ns=received_ns, queue_empty_ns=received_ns)
        assert stream.feed(fresh).reason in in_time


@pytest.mark.parametrize(
    ("silence_ms", "state", "reason"),
    [
        (60, GateState.HOLD, HoldReason.FRAME_MISSING),
        (500, GateState.HOLD, HoldReason.FRAME_MISSING),
        (501, GateState.FAULT, HoldReason.FRAME_TIMEOUT),
    ],
)
def test_silence_holds_at_once_and_faults_when_it_is_no_hiccup(silence_ms, state, reason):
    stream = stream_in(GateState.BEAM_ON)
    last_ns = stream.gate.last.received_ns
    gate = stream.step(Silence(since_ns=0), last_ns + silence_ms * MS)
    assert (gate.state, gate.reason) == (state, reason)


@pytest.mark.parametrize(
    ("ahead_ms", "is_played", "reason"),
    [
        (250, False, HoldReason.FRAME_MISSING),
        (251, False, HoldReason.CLOCK_JUMPED),
        (251, True, HoldReason.FRAME_MISSING),
    ],
)
def test_a_device_clock_that_gets_ahead_of_the_host_s_faults_but_a_player_may_catch_up(ahead_ms, is_played, reason):
    stream = stream_in(GateState.BEAM_ON, limits=replace(LIMITS, is_played=is_played))
    frame = stream.upcoming()
    gate = stream.feed(replace(frame, timestamp_us=frame.timestamp_us + ahead_ms * 1_000))
    assert gate.reason is reason


def test_frames_that_come_in_a_burst_after_a_stall_are_no_jump_of_the_clock():
    stream = stream_in(GateState.BEAM_ON)
    stalled_ns = stream.upcoming().received_ns + 400 * MS
    for behind in range(10):  # a player or a driver that hands over what it kept, one after the other
        frame = replace(stream.upcoming(), received_ns=stalled_ns + behind * MS)
        assert stream.feed(frame).state is GateState.HOLD


@pytest.mark.parametrize("step", [-1, 1])
def test_after_a_jump_is_acknowledged_frames_are_timed_by_the_clock_as_it_is_now(step):
    stream = stream_in(GateState.BEAM_ON)
    states = []
    jump_us = step * 400_000
    frame = stream.upcoming()
    stream.feed(replace(frame, timestamp_us=frame.timestamp_us + jump_us))
    clear_and_arm(stream)
    for _ in range(FRAMES_A_DWELL):
        frame = stream.upcoming()
        states.append(stream.feed(replace(frame, timestamp_us=frame.timestamp_us + jump_us)).state)
    assert states == DWELL_THEN_ON


@pytest.mark.parametrize(
    ("lag_ms", "camera_ms", "reason"),
    [
        (0, 0, None),
        (0, 300, HoldReason.LATENCY_HIGH),
        (240, 50, HoldReason.FRAME_LATE),
        (296, 0, HoldReason.LATENCY_HIGH),
        (200, 96, HoldReason.LATENCY_HIGH),
    ],
)
def test_a_frame_decided_too_long_after_the_camera_took_it_faults(lag_ms, camera_ms, reason):
    """What a decision takes, 5 ms, counts too: 300 ms are allowed here."""
    limits = replace(LIMITS, max_latency_ms=300.0, max_lag_ms=200.0)
    stream = stream_in(GateState.BEAM_ON, limits=limits)
    stream.limits = replace(limits, camera_latency_ms=float(camera_ms))
    frame = stream.upcoming()
    gate = stream.feed(replace(frame, received_ns=frame.received_ns + lag_ms * MS))
    assert gate.reason is reason


def test_a_recording_played_late_is_not_late_itself():
    stream = stream_in(GateState.BEAM_ON, limits=replace(LIMITS, is_played=True))
    frame = stream.upcoming()
    assert stream.feed(replace(frame, received_ns=frame.received_ns + 600 * MS)).reason is HoldReason.FRAME_MISSING


def test_when_a_frame_was_taken_is_counted_back_from_when_it_came():
    limits = replace(LIMITS, camera_latency_ms=40.0)
    stream = stream_in(GateState.BEAM_ON, limits=limits)
    frame = stream.upcoming()
    late = replace(frame, received_ns=frame.received_ns + 20 * MS)
    gate = stream.feed(late)
    drift_ns = 40_000  # what the clocks may have drifted apart since the promptest frame
    assert captured_ns(gate.last, late, limits) == pytest.approx(frame.received_ns - 40 * MS, abs=drift_ns)
    assert captured_ns(gate.last, late, replace(limits, is_played=True)) == late.received_ns - 40 * MS


IRREGULAR = Breath(
    events=(
        BreathEvent(kind=BreathEventKind.SIGH, start_us=1, confidence=0.9),
        BreathEvent(kind=BreathEventKind.COUGH, start_us=1, confidence=0.9, detail="two spikes"),
    )
)


@pytest.mark.parametrize(
    ("holding", "reason"),
    [
        (set(), None),
        ({BreathEventKind.TALKING}, None),
        ({BreathEventKind.COUGH}, HoldReason.BREATHING_IRREGULAR),
        (set(BreathEventKind), HoldReason.BREATHING_IRREGULAR),
    ],
    ids=lambda reported: " ".join(sorted(reported)) or "nothing" if isinstance(reported, set) else str(reported),
)
def test_what_happens_in_the_breathing_holds_where_the_site_wants_it(holding, reason):
    stream = stream_in(GateState.BEAM_ON, limits=replace(LIMITS, holding_events=frozenset(holding)))
    calm = replace(stream.upcoming(), breaths=(Breath(), Breath()))
    assert stream.feed(calm).state is GateState.BEAM_ON
    gate = stream.feed(replace(stream.upcoming(), breaths=(Breath(), IRREGULAR)))
    assert gate.reason is reason
    if holding == {BreathEventKind.COUGH}:
        assert gate.detail == "cough: two spikes"
        assert stream.good(FRAMES_A_DWELL) == DWELL_THEN_ON


def during(kind):
    return (Breath(events=(BreathEvent(kind=kind, start_us=1, confidence=0.9),)),)


@pytest.mark.parametrize("kind", BreathEventKind, ids=str)
def test_by_default_the_beam_is_held_where_breathing_has_ceased_and_for_no_other_event(kind):
    stream = stream_in(GateState.BEAM_ON)
    gate = stream.feed(replace(stream.upcoming(), breaths=during(kind)))
    ceased = kind in {BreathEventKind.APNOEA, BreathEventKind.NO_CYCLE}
    assert gate.reason is (HoldReason.BREATHING_IRREGULAR if ceased else None)


@pytest.mark.parametrize("kind", BreathEventKind, ids=str)
def test_a_breath_hold_is_not_held_for_what_it_resembles(kind):
    hold = BreathHoldWindow(level=amplitude_window(lower_mm=LEVEL_MM - 2.0, upper_mm=LEVEL_MM + 2.0), settle_ms=100.0)
    alone = replace(LIMITS, window=hold, holding_events=frozenset(BreathEventKind))
    joined = replace(alone, window=JoinedWindow(conditions=(LIMITS.window, hold), join="or"))
    holds = kind in {BreathEventKind.COUGH, BreathEventKind.DRIFT}
    assert (kind in alone.judged_events) is holds
    stream = stream_in(GateState.BEAM_ON, limits=joined)
    gate = stream.feed(replace(stream.upcoming(), breaths=during(kind)))
    assert gate.reason is (HoldReason.BREATHING_IRREGULAR if holds else None)


def test_a_camera_that_has_not_begun_yet_is_waited_for():
    assert Stream().step(Silence(since_ns=0), 9_000 * MS).state is GateState.DISARMED


def test_the_first_cause_of_a_fault_stays_until_somebody_has_seen_it():
    stream = stream_in(GateState.BEAM_ON)
    stream.step(Interruption(HoldReason.DISK_LOW, "1 MB left"))
    since_ns = stream.gate.since_ns
    stream.good(3)
    gate = stream.step(Interruption(HoldReason.WATCHDOG))
    assert (gate.reason, gate.detail, gate.since_ns) == (HoldReason.DISK_LOW, "1 MB left", since_ns)


def test_a_device_that_started_its_clock_anew_works_again_after_acknowledgement():
    stream = stream_in(GateState.BEAM_ON)
    back_us = 90_000
    frame = stream.upcoming()
    stream.feed(replace(frame, timestamp_us=frame.timestamp_us - back_us))
    clear_and_arm(stream)
    states = []
    for _ in range(FRAMES_A_DWELL):
        frame = stream.upcoming()
        states.append(stream.feed(replace(frame, timestamp_us=frame.timestamp_us - back_us)).state)
    assert states == DWELL_THEN_ON


@pytest.mark.parametrize(
    ("state", "lost", "detail"),
    [
        (MeasurementState.TRAINING, None, "the motion model is being trained"),
        (
            MeasurementState.LOST,
            Lost(reason=LostReason.MARKER_LOST, detail="three of four markers found"),
            "three of four markers found",
        ),
    ],
)
def test_a_frame_that_was_not_measured_states_why(state, lost, detail):
    stream = stream_in(GateState.BEAM_ON)
    gate = stream.feed(replace(unmeasured(stream.upcoming(), state), lost=lost))
    assert (gate.state, gate.detail) == (GateState.HOLD, detail)


@pytest.mark.parametrize("name", ["valid_share", "inlier_share", "residual_mm"])
def test_a_fit_that_equals_its_bound_is_good_enough(name):
    bound = {"valid_share": "min_valid_share", "inlier_share": "min_inlier_share", "residual_mm": "max_residual_mm"}
    stream = stream_in(GateState.BEAM_ON)
    value = getattr(LIMITS, bound[name])
    assert stream.feed(replace(stream.upcoming(), motion=motion_of(LEVEL_MM, **{name: value}))).state is (
        GateState.BEAM_ON
    )
