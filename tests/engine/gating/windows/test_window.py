"""The window, hysteresis, the signals, the dwell and the bounds of every limit."""

import math
from dataclasses import fields, replace

import pytest

from engine.core.commands import Arm
from engine.core.errors import InvalidValueError
from engine.core.gate_state import GateState, HoldReason, Lease
from engine.gating.gate import Gate, lease_of
from engine.gating.limits import LIMIT_BOUNDS, WHOLE_NUMBERS, GateLimits
from engine.gating.windows import amplitude_window
from tests.support.gating.streams import LIMITS, MS, PERIOD_NS, PERIOD_US, Stream, measured, motion_of, stream_in

WINDOW = amplitude_window(lower_mm=-1.0, upper_mm=3.0, hysteresis_mm=0.2)


@pytest.mark.parametrize(("signal_mm", "enters"), [(-0.81, False), (-0.8, True), (2.8, True), (2.81, False)])
def test_the_signal_enters_the_window_only_by_the_hysteresis(signal_mm, enters):
    stream = stream_in(GateState.HOLD, level_mm=signal_mm)
    assert (stream.feed().state is GateState.DWELL) is enters


@pytest.mark.parametrize("state", [GateState.DWELL, GateState.BEAM_ON], ids=str)
@pytest.mark.parametrize(("level_mm", "edge_mm"), [(2.5, 3.0), (-0.5, -1.0)])
def test_the_signal_leaves_at_the_edge_itself(state, level_mm, edge_mm):
    outside_mm = edge_mm + math.copysign(0.001, edge_mm)
    stream = stream_in(state, level_mm=level_mm)
    stream.level_mm = edge_mm
    assert stream.feed().state is not GateState.HOLD
    stream.level_mm = outside_mm
    assert stream.feed().reason is HoldReason.OUTSIDE_WINDOW


def test_hysteresis_only_ever_takes_beam_on_time_away():
    path_mm = [1.0 + 2.2 * math.sin(0.21 * frame) for frame in range(300)]
    on = {}
    for hysteresis_mm in (0.0, 0.5):
        stream = Stream(replace(LIMITS, window=replace(WINDOW, hysteresis=hysteresis_mm)))
        stream.feed()
        stream.step(Arm(operator="ann"))
        on[hysteresis_mm] = []
        for stream.level_mm in path_mm:
            on[hysteresis_mm].append(stream.feed().state is GateState.BEAM_ON)
    assert sum(on[0.0]) > sum(on[0.5]) > 100
    assert all(without or not with_it for without, with_it in zip(on[0.0], on[0.5], strict=True))


@pytest.mark.parametrize(
    ("signal", "row", "column", "changes"),
    [
        ("whole", None, None, {"whole_mm": 1.75}),
        ("thorax", None, None, {"thorax_mm": 1.75}),
        ("abdomen", None, None, {"abdomen_mm": 1.75}),
        ("region", 13, 7, {"regions_mm": 1.75}),
    ],
)
def test_each_signal_is_the_one_that_is_gated_on(signal, row, column, changes):
    window = amplitude_window(signal=signal, row=row, column=column, lower_mm=-1.0, upper_mm=3.0)
    assert window.choice.value_in(motion_of(**changes)) == 1.75
    others = {"whole_mm": 9.0, "thorax_mm": 9.0, "abdomen_mm": 9.0, "regions_mm": 9.0} | changes
    assert window.contains(window.choice.value_in(motion_of(**others)), was_inside=False)


@pytest.mark.parametrize(("row", "column"), [(14, 0), (0, 8)])
def test_a_region_that_is_not_in_the_grid_faults_instead_of_gating_on_another(row, column):
    window = amplitude_window(signal="region", row=row, column=column, lower_mm=-1.0, upper_mm=3.0)
    gate = Stream(replace(LIMITS, window=window)).feed()
    assert (gate.state, gate.reason) == (GateState.FAULT, HoldReason.VALUE_INVALID)


def test_the_dwell_is_measured_by_the_hosts_clock():
    stream = stream_in(GateState.HOLD)
    first = stream.next_slot
    for number in range(8):  # the host gets the frames of 264 ms within 80 ms
        frame = measured(first + number)
        squeezed_ns = measured(first).received_ns + number * 11 * MS
        gate = stream.feed(replace(frame, received_ns=squeezed_ns))
        assert gate.state is GateState.DWELL


def test_the_dwell_is_measured_by_the_devices_clock():
    stream = stream_in(GateState.HOLD)
    first = stream.next_slot
    for number in range(8):  # 264 ms for the host, 80 ms for the device
        frame = measured(first + number)
        gate = stream.feed(replace(frame, timestamp_us=measured(first).timestamp_us + number * 11_000))
        assert gate.state is not GateState.BEAM_ON


def test_the_dwell_is_measured_by_frames():
    limits = replace(LIMITS, dwell_ms=0.0, min_good_frames=6)
    assert stream_in(GateState.HOLD, limits=limits).good(6) == [GateState.DWELL] * 5 + [GateState.BEAM_ON]


def test_even_without_a_dwell_no_single_frame_turns_the_beam_on():
    limits = replace(LIMITS, dwell_ms=0.0, min_good_frames=2)
    assert stream_in(GateState.HOLD, limits=limits).good(2) == [GateState.DWELL, GateState.BEAM_ON]


@pytest.mark.parametrize("dwell_ms", [3 * PERIOD_US / 1e3, 3 * PERIOD_US / 1e3 + 0.001])
def test_the_dwell_is_over_at_its_length_and_not_before(dwell_ms):
    is_exact = dwell_ms == 3 * PERIOD_US / 1e3
    stream = stream_in(GateState.HOLD, limits=replace(LIMITS, dwell_ms=dwell_ms))
    assert stream.good(4)[-1] is (GateState.BEAM_ON if is_exact else GateState.DWELL)


@pytest.mark.parametrize("state", GateState, ids=str)
def test_a_lease_is_only_worth_something_in_beam_on(state):
    gate = stream_in(state).gate
    lease = lease_of(gate, decided_ns=7, sequence=3, limits=LIMITS)
    expected = Lease(granted_ns=7, expires_ns=gate.last.received_ns + 80 * MS, sequence=3)
    assert lease == (expected if state is GateState.BEAM_ON else None)


def test_a_gate_begins_disarmed():
    assert (Gate().state, Gate().reason, Gate().is_armed) == (GateState.DISARMED, HoldReason.DISARMED, False)


GOOD_WINDOW = {"lower_mm": -1.0, "upper_mm": 3.0}


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"signal": "belly"}, "signal"),
        ({"row": 3}, "row"),
        ({"signal": "region", "row": 3}, "column"),
        ({"signal": "region", "column": 3}, "row"),
        ({"signal": "region", "row": -1, "column": 0}, "row"),
        ({"signal": "region", "row": 350, "column": 0}, "row"),
        ({"signal": "region", "row": 0, "column": 200}, "column"),
        ({"signal": "region", "row": True, "column": 0}, "row"),
        ({"signal": "region", "row": 1.0, "column": 0}, "row"),
        ({"lower_mm": math.nan}, "lower_mm"),
        ({"lower_mm": -201.0}, "lower_mm"),
        ({"lower_mm": "-1"}, "lower_mm"),
        ({"upper_mm": math.nan}, "upper_mm"),
        ({"upper_mm": math.inf}, "upper_mm"),
        ({"upper_mm": -1.0}, "upper_mm"),
        ({"upper_mm": -2.0}, "upper_mm"),
        ({"upper_mm": True}, "upper_mm"),
        ({"hysteresis_mm": -0.1}, "hysteresis_mm"),
        ({"hysteresis_mm": math.nan}, "hysteresis_mm"),
        ({"hysteresis_mm": 2.0}, "hysteresis_mm"),
    ],
    ids=str,
)
def test_a_window_that_is_none_is_refused_by_field_and_bound(changes, field):
    with pytest.raises(InvalidValueError) as refusal:
        amplitude_window(**(GOOD_WINDOW | changes))
    assert refusal.value.field == field
    assert refusal.value.bound


@pytest.mark.parametrize("name", LIMIT_BOUNDS)
def test_every_limit_is_refused_just_out_of_its_bounds_and_as_nan(name):
    low, high = LIMIT_BOUNDS[name]
    step = 1 if name in WHOLE_NUMBERS else 1e-6
    for value in (low - step, high + step, math.nan, math.inf, None, "5"):
        with pytest.raises(InvalidValueError) as refusal:
            GateLimits(window=WINDOW, **{name: value})
        assert refusal.value.field == name


def test_every_number_among_the_limits_has_a_bound():
    assert {field.name for field in fields(GateLimits)} - {
        *("window", "is_played", "is_calibrated", "warm_up_s", "cold_share", "breath_depths"),
        *("head_direction", "holding_events", "needs_all_checks", "needs_countersignature"),
    } == set(LIMIT_BOUNDS)


@pytest.mark.parametrize(("name", "value"), [("warm_up_s", -1.0), ("warm_up_s", 14_401.0), ("cold_share", 1.1)])
def test_a_warmth_that_cannot_be_is_refused(name, value):
    with pytest.raises(InvalidValueError, match=name):
        GateLimits(window=WINDOW, **{name: value})


def test_limits_that_contradict_each_other_are_refused():
    with pytest.raises(InvalidValueError, match="max_silence_ms"):
        GateLimits(window=WINDOW, max_silence_ms=50.0, max_gap_ms=60.0)
    with pytest.raises(InvalidValueError, match="min_good_frames"):
        GateLimits(window=WINDOW, min_good_frames=2.5)


def test_the_defaults_keep_the_lease_under_three_frame_periods_and_over_the_gap():
    limits = GateLimits(window=WINDOW)
    assert limits.max_gap_ms < limits.lease_ms < 3 * PERIOD_NS / MS
    assert limits.max_gap_ms < 2 * PERIOD_NS / MS  # a missing frame holds within one period of when it was due


@pytest.mark.parametrize(
    ("changes", "field", "value", "bound"),
    [
        ({"lower": 3.0}, "upper_mm", "3.0", "more than lower_mm (3)"),
        ({"hysteresis": 2.0}, "hysteresis_mm", "2.0", "less than half the window's width (2)"),
    ],
)
def test_edges_that_make_no_window_are_refused_by_field_value_and_bound(changes, field, value, bound):
    with pytest.raises(InvalidValueError) as refusal:
        replace(WINDOW, **changes)
    assert (refusal.value.field, refusal.value.value, refusal.value.bound) == (field, value, bound)


def test_a_limit_that_has_to_be_whole_states_it_and_limits_that_have_to_be_in_order_may_be_equal():
    with pytest.raises(InvalidValueError) as refusal:
        GateLimits(window=WINDOW, min_good_frames=4.5)
    found = refusal.value
    assert (found.field, found.value, found.bound) == ("min_good_frames", "4.5", "a whole number")
    equal = GateLimits(window=WINDOW, max_silence_ms=150.0, max_gap_ms=150.0)
    assert equal.max_silence_ms == equal.max_gap_ms
    with pytest.raises(InvalidValueError, match=r"^max_silence_ms is 149\.0: must be at least max_gap_ms \(150\)$"):
        replace(equal, max_silence_ms=149.0)
    assert GateLimits(window=WINDOW, max_latency_ms=120.0, warn_latency_ms=120.0).warn_latency_ms == 120.0
