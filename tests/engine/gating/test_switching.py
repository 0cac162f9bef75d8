"""How often the beam may switch: shortest off, shortest on, cycles a minute. None of them ever delays an off."""

from dataclasses import replace

import pytest
from hypothesis import given, settings, strategies as st

from engine.core.commands import Acknowledge, Arm, Disarm
from engine.core.gate_state import GateState, HoldReason
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits
from tests.support.gating.streams import FRAMES_A_DWELL, LEVEL_MM, LIMITS, MS, PERIOD_NS, Stream, stream_in

pytestmark = pytest.mark.slow

FAR_MM = 9.0
EASY = replace(LIMITS, max_jump_mm=20.0)


def on(limits: GateLimits) -> Stream:
    return stream_in(GateState.BEAM_ON, limits=limits)


def leave(stream: Stream, frames: int = 1) -> None:
    stream.level_mm = FAR_MM
    assert set(stream.good(frames)) == {GateState.HOLD}
    stream.level_mm = LEVEL_MM


def test_the_beam_stays_off_for_the_shortest_off():
    stream = on(replace(EASY, min_off_ms=1_000.0))
    leave(stream)
    off_ns = stream.gate.off_since_ns
    states = stream.good(40)
    first = states.index(GateState.BEAM_ON)
    assert stream.gate.turned_on_ns[-1] - off_ns >= 1_000 * MS
    assert stream.gate.turned_on_ns[-1] - off_ns < 1_000 * MS + PERIOD_NS
    assert set(states[FRAMES_A_DWELL - 1 : first]) == {GateState.DWELL}


def test_while_it_waits_it_states_for_what():
    stream = on(replace(EASY, min_off_ms=1_000.0))
    leave(stream)
    stream.good(FRAMES_A_DWELL)
    assert (stream.gate.state, stream.gate.reason) == (GateState.DWELL, HoldReason.SHORTEST_OFF)


@pytest.mark.parametrize("way", ["disarm", "fault", "silence in words"])
def test_no_way_around_shortens_the_time_off(way):
    stream = on(replace(EASY, min_off_ms=2_000.0))
    if way == "disarm":
        stream.step(Disarm(operator="ann"))
    elif way == "fault":
        stream.step(Interruption(HoldReason.SOURCE_LOST))
        stream.step(Acknowledge(operator="ann"))
    else:
        stream.step(Interruption(HoldReason.MODEL_MISSING))
    off_ns = stream.now_ns
    stream.step(Arm(operator="ann"))
    states = stream.good(70)
    assert GateState.BEAM_ON in states
    assert stream.gate.turned_on_ns[-1] - off_ns >= 2_000 * MS


def test_the_first_time_on_waits_for_no_time_off():
    stream = stream_in(GateState.HOLD, limits=replace(EASY, min_off_ms=60_000.0))
    assert stream.good(FRAMES_A_DWELL)[-1] is GateState.BEAM_ON


def test_no_more_cycles_in_any_minute_than_allowed():
    limits = replace(EASY, max_cycles_per_min=5, dwell_ms=50.0, min_good_frames=2)
    stream = stream_in(GateState.HOLD, limits=limits)
    ons: list[int] = []
    for _ in range(600):  # a patient in and out of the window every seven frames, for over two minutes
        for level_mm in (LEVEL_MM,) * 4 + (FAR_MM,) * 3:
            stream.level_mm = level_mm
            was_on = stream.gate.state is GateState.BEAM_ON
            if stream.feed().state is GateState.BEAM_ON and not was_on:
                ons.append(stream.now_ns)
    assert len(ons) >= 10
    assert all(later - earlier >= 60_000 * MS for earlier, later in zip(ons, ons[5:], strict=False))
    assert len(stream.gate.turned_on_ns) <= 5


def test_cycles_count_for_a_whole_minute():
    stream = stream_in(GateState.HOLD, limits=replace(EASY, max_cycles_per_min=3))
    for away in (930, 120, 120):  # on at 0, 31 and 35 s
        assert GateState.BEAM_ON in stream.good(6)
        leave(stream, away)
    first_ns = stream.gate.turned_on_ns[0]
    states = stream.good(900)
    assert GateState.BEAM_ON in states
    assert stream.gate.turned_on_ns[-1] - first_ns >= 60_000 * MS


def test_the_cycle_limit_is_reported():
    limits = replace(EASY, max_cycles_per_min=1)
    stream = on(limits)
    leave(stream)
    stream.good(FRAMES_A_DWELL + 1)
    assert (stream.gate.state, stream.gate.reason) == (GateState.DWELL, HoldReason.CYCLE_LIMIT)


def test_after_a_time_on_that_was_too_short_the_dwell_is_longer_until_one_has_lasted():
    limits = replace(EASY, min_on_ms=300.0)
    stream = on(limits)  # on for three frames: 100 ms
    leave(stream)
    states = stream.good(20)
    assert states.index(GateState.BEAM_ON) == 12  # 100 ms + 300 ms are twelve periods
    stream.good(10)
    leave(stream)
    assert stream.good(FRAMES_A_DWELL)[-1] is GateState.BEAM_ON


def test_the_shortest_on_never_keeps_a_beam_on():
    stream = stream_in(GateState.HOLD, limits=replace(EASY, min_on_ms=10_000.0))
    stream.good(FRAMES_A_DWELL)
    assert stream.gate.state is GateState.BEAM_ON
    stream.level_mm = FAR_MM
    assert stream.feed().state is GateState.HOLD


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, 40), st.integers(1, 10)), min_size=1, max_size=8),
    st.floats(0.0, 800.0),
    st.floats(0.0, 2_000.0),
    st.integers(1, 6),
)
def test_switching_limits_only_ever_take_beam_on_time_away(visits, min_on_ms, min_off_ms, cycles):
    """With them the beam is on only where it would be on without them, and off at the very same frames."""
    strict = replace(EASY, min_on_ms=min_on_ms, min_off_ms=min_off_ms, max_cycles_per_min=cycles)
    plain, limited = (stream_in(GateState.HOLD, limits=limits) for limits in (EASY, strict))
    for inside, outside in visits:
        for level_mm in (LEVEL_MM,) * inside + (FAR_MM,) * outside:
            plain.level_mm = limited.level_mm = level_mm
            without, with_them = plain.feed().state, limited.feed().state
            assert without is GateState.BEAM_ON or with_them is not GateState.BEAM_ON
            assert level_mm == LEVEL_MM or with_them is GateState.HOLD
