"""The gate at the very instant: each bound just kept and just broken, and what is reported of it."""

from dataclasses import replace

import pytest

from engine.core.commands import Acknowledge, Arm, Disarm
from engine.core.frames import MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.frame_checks import LastFrame
from engine.gating.gate import CYCLES_WITHIN_NS, Ending, Gate, Interruption, Silence, lease_of, step_gate
from engine.gating.windows import ConditionState
from engine.gating.windows.patient_breath import SignalTrail
from tests.support.gating.streams import (
    LIMITS,
    MS,
    PERIOD_NS,
    START_NS,
    Stream,
    measured,
    motion_of,
    stream_in,
    unmeasured,
)

EASY = replace(LIMITS, max_jump_mm=20.0, dwell_ms=0.0, min_good_frames=3)


def fed_at(stream: Stream, now_ns: int) -> Gate:
    """The next frame, good, fresh and in order, decided on at that time."""
    last = stream.gate.last
    received_ns, step_us = now_ns - MS, (now_ns - MS - last.received_ns) // 1_000
    frame = replace(stream.upcoming(), received_ns=received_ns, timestamp_us=last.timestamp_us + step_us)
    stream.now_ns = now_ns
    return stream.step(frame)


# The dwell.


@pytest.mark.parametrize(
    ("frames", "host_ns", "device_us", "is_on"),
    [
        (3, 100 * MS, 100_000, True),
        (2, 100 * MS, 100_000, False),
        (3, 100 * MS - 1, 100_000, False),
        (3, 100 * MS, 99_999, False),
    ],
    ids=["all three", "a frame short", "a nanosecond short", "a microsecond of the camera's short"],
)
def test_a_dwell_is_over_when_frames_host_and_camera_all_say_so(frames, host_ns, device_us, is_on):
    stream = stream_in(GateState.DWELL)
    frame = stream.upcoming()
    stream.gate = replace(
        stream.gate,
        good_frames=frames - 1,
        inside_since_ns=frame.received_ns - host_ns,
        inside_since_us=frame.timestamp_us - device_us,
    )
    assert (stream.feed(frame).state is GateState.BEAM_ON) is is_on


@pytest.mark.parametrize("missing", ["inside_since_ns", "inside_since_us"])
def test_a_run_without_a_beginning_is_none_and_begins_with_this_frame(missing):
    stream = stream_in(GateState.BEAM_ON)
    stream.gate = replace(stream.gate, **{missing: None})
    assert stream.feed().state is GateState.HOLD
    stream = stream_in(GateState.DWELL)
    stream.gate = replace(stream.gate, **{missing: None})
    frame = stream.upcoming()
    gate = stream.feed(frame)
    assert (gate.state, gate.good_frames) == (GateState.DWELL, 1)
    assert (gate.inside_since_ns, gate.inside_since_us) == (frame.received_ns, frame.timestamp_us)


def test_a_run_is_counted_from_its_first_frame_and_forgotten_with_it():
    stream = stream_in(GateState.HOLD)
    first = stream.upcoming()
    stream.feed(first)
    for frames in range(2, 8):
        gate = stream.feed()
        assert gate.good_frames == frames
        assert (gate.inside_since_ns, gate.inside_since_us) == (first.received_ns, first.timestamp_us)
    gate = stream.feed(unmeasured(stream.upcoming(), MeasurementState.TRAINING))
    assert (gate.good_frames, gate.inside_since_ns, gate.inside_since_us) == (0, None, None)


# The lease.


@pytest.mark.parametrize(("beyond_ns", "state"), [(-1, GateState.BEAM_ON), (0, GateState.HOLD), (1, GateState.HOLD)])
def test_a_frame_decided_on_at_the_end_of_the_lease_before_it_finds_the_line_off(beyond_ns, state):
    stream = stream_in(GateState.BEAM_ON)
    end_ns = stream.gate.last.received_ns + 80 * MS
    frame = stream.upcoming()
    gate = stream.feed(frame, age_ns=end_ns + beyond_ns - frame.received_ns)
    assert gate.state is state
    if state is GateState.HOLD:
        assert (gate.reason, gate.detail) == (
            HoldReason.FRAME_LATE,
            "decided 0 ms after the line's lease had lapsed",
        )


def test_how_long_ago_a_lease_had_lapsed_is_reported_in_milliseconds():
    stream = stream_in(GateState.BEAM_ON)
    frame = stream.upcoming()
    gate = stream.feed(frame, age_ns=stream.gate.last.received_ns + 87 * MS - frame.received_ns)
    assert gate.detail == "decided 7 ms after the line's lease had lapsed"


def test_a_lease_states_when_it_was_decided_when_it_ends_and_its_number_and_is_for_a_frame():
    stream = stream_in(GateState.BEAM_ON)
    lease = lease_of(stream.gate, decided_ns=77, sequence=5, limits=LIMITS)
    received_ns = stream.gate.last.received_ns
    assert (lease.granted_ns, lease.expires_ns, lease.sequence) == (77, received_ns + 80 * MS, 5)
    assert lease_of(replace(stream.gate, last=None), decided_ns=77, sequence=5, limits=LIMITS) is None
    held = replace(stream.gate, state=GateState.DWELL)
    assert lease_of(held, decided_ns=77, sequence=5, limits=LIMITS) is None


def test_a_beam_that_is_on_without_any_frame_cannot_be_and_holds():
    stream = stream_in(GateState.BEAM_ON)
    stream.gate = replace(stream.gate, last=None, inside_since_ns=None)
    assert stream.feed().state is GateState.HOLD


# How often it may switch.


@pytest.mark.parametrize(("rested_ns", "is_on"), [(1_000 * MS - 1, False), (1_000 * MS, True)])
def test_the_shortest_off_is_over_at_its_end(rested_ns, is_on):
    stream = stream_in(GateState.DWELL, limits=replace(EASY, min_off_ms=1_000.0))
    now_ns = stream.gate.last.received_ns + PERIOD_NS
    stream.gate = replace(stream.gate, off_since_ns=now_ns - rested_ns)
    gate = fed_at(stream, now_ns)
    assert (gate.state is GateState.BEAM_ON) is is_on
    if not is_on:
        assert (gate.reason, gate.detail) == (HoldReason.SHORTEST_OFF, "off for 1000 of 1000 ms")


@pytest.mark.parametrize("off_ms", [-500, 0, 400])
def test_how_long_the_beam_was_off_is_reported(off_ms):
    stream = stream_in(GateState.DWELL, limits=replace(EASY, min_off_ms=1_000.0))
    now_ns = stream.gate.last.received_ns + PERIOD_NS
    stream.gate = replace(stream.gate, off_since_ns=now_ns - off_ms * MS)
    assert fed_at(stream, now_ns).detail == f"off for {max(off_ms, 0)} of 1000 ms"


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        (replace(EASY, min_off_ms=60_000.0), HoldReason.SHORTEST_OFF),
        (replace(EASY, max_cycles_per_min=1), HoldReason.CYCLE_LIMIT),
    ],
    ids=["shortest off", "cycle limit"],
)
def test_who_waits_to_go_on_again_stays_inside_up_to_the_very_edges_meanwhile(limits, reason):
    stream = stream_in(GateState.BEAM_ON, limits=limits)
    stream.step(Interruption(HoldReason.MARKER_LOST))
    stream.good(4)
    assert (stream.gate.state, stream.gate.reason) == (GateState.DWELL, reason)
    for _ in range(3):
        stream.feed(replace(stream.upcoming(), motion=motion_of(2.9)))  # where no one enters, and no one leaves
        assert (stream.gate.state, stream.gate.reason) == (GateState.DWELL, reason)


@pytest.mark.parametrize(("ago_ns", "is_on"), [(CYCLES_WITHIN_NS - 1, False), (CYCLES_WITHIN_NS, True)])
def test_a_cycle_counts_for_a_minute_and_not_an_instant_longer(ago_ns, is_on):
    stream = stream_in(GateState.DWELL, limits=replace(EASY, max_cycles_per_min=2))
    now_ns = stream.gate.last.received_ns + PERIOD_NS
    stream.gate = replace(stream.gate, turned_on_ns=(now_ns - ago_ns, now_ns - 1_000 * MS))
    gate = fed_at(stream, now_ns)
    assert (gate.state is GateState.BEAM_ON) is is_on
    if is_on:
        assert gate.turned_on_ns == (now_ns - 1_000 * MS, now_ns)
    else:
        assert (gate.reason, gate.detail) == (HoldReason.CYCLE_LIMIT, "2 times on within a minute, 2 allowed")


def test_a_beam_that_is_on_is_not_asked_how_often_it_may_switch():
    limits = replace(LIMITS, min_off_ms=60_000.0, max_cycles_per_min=1)
    stream = stream_in(GateState.BEAM_ON, limits=limits)
    stream.gate = replace(stream.gate, off_since_ns=stream.now_ns)
    assert stream.good(3) == [GateState.BEAM_ON] * 3
    assert len(stream.gate.turned_on_ns) == 1


@pytest.mark.parametrize(("on_for_ns", "is_short"), [(300 * MS - 1, True), (300 * MS, False)])
@pytest.mark.parametrize(
    "end", [Disarm(operator="ann"), Ending(HoldReason.SOURCE_ENDED), Interruption(HoldReason.JUMP)]
)
def test_a_time_on_is_too_short_until_it_has_lasted_and_is_noted_with_its_end(on_for_ns, is_short, end):
    stream = stream_in(GateState.BEAM_ON, limits=replace(LIMITS, min_on_ms=300.0))
    now_ns = stream.gate.turned_on_ns[-1] + on_for_ns
    gate = stream.step(end, now_ns)
    assert (gate.was_cut_short, gate.off_since_ns) == (is_short, now_ns)
    later = stream.step(Silence(since_ns=0), now_ns + MS)
    assert (later.was_cut_short, later.off_since_ns) == (is_short, now_ns)


def test_the_newest_time_on_is_what_counts_of_several():
    stream = stream_in(GateState.BEAM_ON, limits=replace(LIMITS, min_on_ms=300.0))
    on_ns = stream.gate.turned_on_ns[-1]
    stream.gate = replace(stream.gate, turned_on_ns=(on_ns - 5_000 * MS, on_ns))
    assert stream.step(Disarm(operator="ann"), on_ns + 299 * MS).was_cut_short


# Silence.


@pytest.mark.parametrize(
    ("silent_ns", "state", "reason"),
    [
        (500 * MS, GateState.HOLD, HoldReason.FRAME_MISSING),
        (500 * MS + 1, GateState.FAULT, HoldReason.FRAME_TIMEOUT),
    ],
)
def test_a_silence_is_a_fault_when_it_has_lasted_for_longer_than_it_may(silent_ns, state, reason):
    stream = stream_in(GateState.BEAM_ON)
    gate = stream.step(Silence(since_ns=0), stream.gate.last.received_ns + silent_ns)
    assert (gate.state, gate.reason, gate.detail) == (state, reason, "no frame for 500 ms")


def test_a_silence_before_the_first_frame_is_no_fault_and_is_counted_from_when_listening_began():
    gate = step_gate(Gate(), Arm(operator="ann"), START_NS, LIMITS)
    gate = step_gate(gate, Silence(since_ns=START_NS), START_NS + 3_000 * MS, LIMITS)
    assert (gate.state, gate.reason, gate.detail) == (
        GateState.HOLD,
        HoldReason.FRAME_MISSING,
        "no frame for 3000 ms",
    )


# What is reported.


def test_since_when_something_is_so_is_kept_for_as_long_as_state_and_reason_are():
    stream = stream_in(GateState.HOLD)
    began_ns = stream.now_ns + 10 * MS
    stream.step(Interruption(HoldReason.MARKER_LOST, "one"), began_ns)
    assert stream.step(Interruption(HoldReason.MARKER_LOST, "two"), began_ns + MS).since_ns == began_ns
    assert stream.gate.detail == "two"
    assert stream.step(Interruption(HoldReason.JUMP), began_ns + 2 * MS).since_ns == began_ns + 2 * MS
    assert stream.step(Disarm(operator="ann"), began_ns + 3 * MS).since_ns == began_ns + 3 * MS
    stream.step(Arm(operator="ann"), began_ns + 4 * MS)
    assert (stream.gate.since_ns, stream.gate.reason) == (began_ns + 4 * MS, HoldReason.DWELL)


def test_the_first_cause_of_a_fault_keeps_its_time_and_its_words():
    stream = stream_in(GateState.BEAM_ON)
    at_ns = stream.now_ns + MS
    stream.step(Interruption(HoldReason.DISK_LOW, "20 MB left"), at_ns)
    for event in (Interruption(HoldReason.WATCHDOG, "late"), Disarm(operator="ann"), Interruption(HoldReason.DISK_LOW)):
        gate = stream.step(event, at_ns + MS)
        assert (gate.reason, gate.detail, gate.since_ns) == (HoldReason.DISK_LOW, "20 MB left", at_ns)


@pytest.mark.parametrize("state", [GateState.HOLD, GateState.DWELL, GateState.BEAM_ON])
def test_an_end_is_reported_with_its_reason_and_a_disarming_as_such(state):
    gate = stream_in(state).step(Ending(HoldReason.SOURCE_ENDED, "the last frame"))
    assert (gate.state, gate.reason, gate.detail) == (GateState.DISARMED, HoldReason.SOURCE_ENDED, "the last frame")
    gate = stream_in(state).step(Disarm(operator="ann"))
    assert (gate.state, gate.reason, gate.detail) == (GateState.DISARMED, HoldReason.DISARMED, "")


def test_a_fault_that_was_acknowledged_leaves_no_words_behind():
    stream = stream_in(GateState.FAULT)
    gate = stream.step(Acknowledge(operator="ann"))
    assert (gate.state, gate.reason, gate.detail) == (GateState.DISARMED, HoldReason.DISARMED, "")


def test_a_beam_that_is_on_has_neither_reason_nor_words():
    stream = stream_in(GateState.HOLD)
    stream.step(Interruption(HoldReason.JUMP, "3 mm"))
    stream.good(5)
    assert (stream.gate.state, stream.gate.reason, stream.gate.detail) == (GateState.BEAM_ON, None, "")


def test_something_unknown_is_named_by_its_kind():
    gate = stream_in(GateState.BEAM_ON).step("turn on")
    assert (gate.reason, gate.detail) == (HoldReason.UNKNOWN, "str is no event of the gate")


def test_a_frame_outside_is_reported_with_what_it_was_and_the_window():
    stream = stream_in(GateState.BEAM_ON)
    gate = stream.feed(replace(stream.upcoming(), motion=motion_of(3.2)))
    assert (gate.reason, gate.detail) == (
        HoldReason.OUTSIDE_WINDOW,
        "3.20 mm is not inside -1.00 to 3.00 mm",
    )


# What is remembered.


def without_trail(stream):
    return tuple(replace(state, trail=SignalTrail()) for state in stream.gate.conditions)


def test_what_the_window_remembers_is_kept_while_inside_left_when_outside_and_begun_anew_at_arming():
    stream = stream_in(GateState.HOLD)
    assert without_trail(stream) == (ConditionState(),)
    stream.feed()
    assert stream.gate.conditions[0].is_inside
    stream.feed(replace(stream.upcoming(), motion=motion_of(3.2)))
    assert not stream.gate.conditions[0].is_inside
    stream.feed()
    stream.gate = replace(stream.gate, conditions=(replace(stream.gate.conditions[0], holds=3),))
    assert stream.gate.breath_holds == 3
    trail = stream.gate.conditions[0].trail
    stream.step(Arm(operator="ann"))
    assert without_trail(stream) == (ConditionState(),)
    assert stream.gate.conditions[0].trail == trail


@pytest.mark.parametrize("state", [GateState.DISARMED, GateState.FAULT])
def test_no_request_is_counted_without_requests(state):
    stream = stream_in(state)
    stream.feed()
    assert not any(condition.is_inside for condition in stream.gate.conditions)


def test_a_gate_that_remembers_another_window_s_conditions_begins_anew():
    stream = stream_in(GateState.DWELL)
    stream.gate = replace(stream.gate, conditions=(ConditionState(is_inside=True), ConditionState(is_inside=True)))
    stream.feed(replace(stream.upcoming(), motion=motion_of(2.9)))  # inside, but not far enough to enter
    assert stream.gate.reason is HoldReason.OUTSIDE_WINDOW


def test_every_frame_is_remembered_whatever_came_of_it():
    stream = stream_in(GateState.FAULT)
    frame = stream.upcoming()
    stream.feed(frame)
    assert isinstance(stream.gate.last, LastFrame)
    assert (stream.gate.last.index, stream.gate.last.received_ns) == (frame.frame_index, frame.received_ns)
    before = stream.gate.last
    for event in (Silence(since_ns=0), Acknowledge(operator="ann"), Arm(operator="ann"), Disarm(operator="ann")):
        assert stream.step(event).last is before


def test_a_frame_that_states_it_was_measured_and_has_no_motion_faults_by_name():
    stream = stream_in(GateState.BEAM_ON)
    gate = stream.feed(replace(stream.upcoming(), motion=None))
    assert (gate.state, gate.reason) == (GateState.FAULT, HoldReason.VALUE_INVALID)
    assert measured(0).motion is not None
