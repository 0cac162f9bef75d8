"""What is counted of frames and of the gate, by hand."""

from dataclasses import replace

import pytest

from engine.core.gate_state import GateState, HoldReason
from service.sessions.lifecycle.counters import LONGEST_STEP_S, SessionCounters
from tests.support.service.fake_engine import FRAME_NS, FakeRunning

FRAME_S = FRAME_NS / 1e9


@pytest.fixture
def tallies():
    return SessionCounters()


@pytest.fixture
def running():
    return FakeRunning(None)


def value(tallies, name, **labels):
    return tallies.registry.get_sample_value(name, labels)


def test_the_time_with_the_line_on_is_counted_from_frame_to_frame(tallies, running):
    for line_on in (False, True, True, False, False):
        tallies.frame(running.frame(line_on=line_on))
    assert value(tallies, "tidegate_line_on_frames_total") == 2.0
    assert value(tallies, "tidegate_line_on_seconds_total") == pytest.approx(2.0 * FRAME_S)


def test_a_gap_between_frames_is_no_time_with_the_line_on(tallies, running):
    first, second = running.frame(line_on=True), running.frame()
    tallies.frame(first)
    tallies.frame(replace(second, decided_ns=first.decided_ns + 3_600_000_000_000))
    assert value(tallies, "tidegate_line_on_seconds_total") == LONGEST_STEP_S


def test_a_clock_that_goes_back_takes_no_time_away(tallies, running):
    first, second = running.frame(line_on=True), running.frame()
    tallies.frame(second)
    tallies.frame(replace(first, decided_ns=second.decided_ns + 5))
    tallies.frame(first)
    assert value(tallies, "tidegate_line_on_seconds_total") == 0.0


def test_decisions_are_timed_from_the_frame_in_our_hands(tallies, running):
    record = running.frame()
    tallies.frame(
        replace(record, decided_ns=record.received_ns + 7_000_000, asserted_ns=record.received_ns + 9_500_000)
    )
    assert value(tallies, "tidegate_decision_seconds_sum") == pytest.approx(0.007)
    assert value(tallies, "tidegate_decision_seconds_bucket", le="0.008") == 1.0
    assert value(tallies, "tidegate_decision_seconds_bucket", le="0.006") == 0.0
    assert value(tallies, "tidegate_assertion_seconds_sum") == pytest.approx(0.0025)


def test_holds_and_interruptions_are_counted_by_their_reason(tallies, running):
    for state, reason in (
        (GateState.HOLD, HoldReason.OUTSIDE_WINDOW),
        (GateState.DWELL, HoldReason.DWELL),
        (GateState.BEAM_ON, None),
        (GateState.HOLD, HoldReason.MARKER_LOST),
        (GateState.HOLD, HoldReason.OUTSIDE_WINDOW),
        (GateState.BEAM_ON, None),
        (GateState.FAULT, HoldReason.WATCHDOG),
        (GateState.DISARMED, HoldReason.DISARMED),
    ):
        tallies.transition(running.transition(state, reason))
    held = {reason: value(tallies, "tidegate_holds_total", reason=reason.value) for reason in HoldReason}
    assert {reason: count for reason, count in held.items() if count} == {
        HoldReason.OUTSIDE_WINDOW: 2.0,
        HoldReason.MARKER_LOST: 1.0,
        HoldReason.WATCHDOG: 1.0,
    }
    broken = {reason: value(tallies, "tidegate_beam_interruptions_total", reason=reason.value) for reason in HoldReason}
    assert {reason: count for reason, count in broken.items() if count} == {
        HoldReason.MARKER_LOST: 1.0,
        HoldReason.WATCHDOG: 1.0,
    }
