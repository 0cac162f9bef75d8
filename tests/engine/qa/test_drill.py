"""The fail-safe drill finds what it is for, and leaves every line off."""

import threading
from dataclasses import replace

import pytest

from engine.beam.heartbeat_drill import DrilledReceiver
from engine.beam.paired import PairedBeamLine
from engine.beam.simulated import SimulatedAccelerator, SimulatedBeamLine, SimulatedReceiver
from engine.core.clock import NS_PER_S, MonotonicClock
from engine.core.errors import InvalidValueError
from engine.core.gate_state import HoldReason
from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.checks import check_of
from engine.qa.drill import DRILLS, drill_line
from engine.qa.inputs import BeamInput
from engine.qa.results import QaKind, QaNeed, QaVerdict
from engine.qa.run import judge_all
from tests.support.qa.faulty_lines import (
    Dead,
    DeafToHolds,
    DeafToLeases,
    DiesOnTheWay,
    DropsEarly,
    Line,
    NeverLatches,
    NeverOn,
    NoHeartbeatRule,
    OnByItself,
    OnWhenArmed,
    SlowLeases,
    SlowOnce,
    SlowReceiver,
    SlowToHold,
    beam_of,
)

LINES = (Dead, DeafToLeases, DiesOnTheWay, Line, NeverLatches, NeverOn, OnByItself, OnWhenArmed, SlowLeases, SlowToHold)


def drilled(given, on_pulse=lambda _done: None):
    figures = drill_line(given, on_pulse)
    results = judge_all(QaKind.DAILY, figures, QaBounds(), QaBaseline())
    return {result.code: result for result in results if check_of(result.code).needs is QaNeed.BEAM}


def failed(results):
    return {code for code, result in results.items() if result.verdict is QaVerdict.FAIL}


def test_a_healthy_line_passes_every_drill():
    results = drilled(beam_of())
    assert {result.verdict for result in results.values()} == {QaVerdict.PASS}
    assert all("5 times" in results[f"fail_safe_{name}_ms"].detail for name in DRILLS)
    assert results["beam_readback_errors"].value == 0.0


@pytest.mark.parametrize(
    ("line", "drills", "says"),
    [
        (SlowToHold, {"hold", "fault"}, ""),
        (DeafToLeases, {"lease"}, "never read back off"),
        (SlowLeases, {"lease"}, ""),
        (NeverLatches, {"fault", "watchdog"}, "not refused"),
        (OnByItself, {"fault", "watchdog"}, "went on by itself"),
        (OnWhenArmed, {"fault", "watchdog"}, "without a permit"),
        (NeverOn, set(DRILLS), "never read back on"),
        (Dead, set(DRILLS), "nobody answers"),
        (DiesOnTheWay, set(DRILLS), "cable is out"),
    ],
)
def test_each_fault_of_a_line_fails_its_drill_and_is_named(line, drills, says):
    results = drilled(beam_of(line))
    codes = {f"fail_safe_{name}_ms" for name in drills}
    assert codes <= failed(results)
    if line not in {NeverOn, Dead, DiesOnTheWay, SlowToHold}:
        others = {f"fail_safe_{name}_ms" for name in DRILLS} - codes
        assert not others & failed(results)
    assert any(says in results[code].detail for code in codes)


def test_a_receiver_without_the_heartbeat_s_rule_fails_daily_qa_and_the_text_states_it():
    results = drilled(beam_of(receiver_class=NoHeartbeatRule))
    assert failed(results) == {"fail_safe_heartbeat_ms", "beam_readback_errors"}
    assert results["fail_safe_heartbeat_ms"].value is None
    assert "its line: the contact stayed closed for 500 ms" in results["fail_safe_heartbeat_ms"].detail


def test_a_receiver_that_drops_the_permit_too_late_fails_with_its_time():
    results = drilled(beam_of(receiver_class=SlowReceiver))
    assert failed(results) == {"fail_safe_heartbeat_ms"}
    assert results["fail_safe_heartbeat_ms"].value == pytest.approx(300.0, abs=2.0)


def test_a_receiver_whose_contact_cannot_be_seen_otherwise_does_not_pass_and_is_not_called_a_failing_line():
    results = drilled(beam_of(receiver_class=None))
    assert failed(results) == {"fail_safe_heartbeat_ms"}
    assert "its line: not verifiable: no second input configured" in results["fail_safe_heartbeat_ms"].detail
    assert results["beam_readback_errors"].value == 0.0


@pytest.mark.parametrize("faulty", [None, 0, 1], ids=["both good", "first", "second"])
def test_of_two_lines_every_receiver_has_to_drop_the_permit(faulty):
    given = beam_of()
    lines = [Line(given.clock) for _ in range(2)]
    receivers = tuple(
        DrilledReceiver(
            name=f"line {number}",
            line=line,
            second_input=(NoHeartbeatRule if number == faulty else SimulatedReceiver)(line, given.clock),
        )
        for number, line in enumerate(lines)
    )
    results = drilled(replace(given, line=PairedBeamLine(*lines), receivers=receivers))
    assert ("fail_safe_heartbeat_ms" in failed(results)) is (faulty is not None)
    if faulty is not None:
        assert f"line {faulty}: the contact stayed closed" in results["fail_safe_heartbeat_ms"].detail


def test_one_repetition_without_the_receiver_s_rule_is_enough_to_fail():
    class Lapses(NoHeartbeatRule):
        looks = 0

        def open(self):
            self.looks += 1
            self.drop_ms = 10**9 if self.looks == 3 else 200.0

    results = drilled(beam_of(receiver_class=Lapses))
    assert "4 of 5 succeeded" in results["fail_safe_heartbeat_ms"].detail
    assert "fail_safe_heartbeat_ms" in failed(results)


def test_how_late_a_hold_and_a_lease_are_is_reported_from_when_they_should_have_been_obeyed():
    assert drilled(beam_of(SlowToHold))["fail_safe_hold_ms"].value == pytest.approx(130.0, abs=2.0)
    assert drilled(beam_of(SlowLeases))["fail_safe_lease_ms"].value == pytest.approx(130.0, abs=2.0)


def test_the_slowest_of_all_times_is_what_counts():
    results = drilled(beam_of(SlowOnce))
    assert results["fail_safe_hold_ms"].value == pytest.approx(130.0, abs=2.0)
    assert results["fail_safe_hold_ms"].verdict is QaVerdict.FAIL
    assert failed(results) <= {"fail_safe_hold_ms", "beam_readback_off_ms"}


def test_an_unsupervised_engine_that_stops_fails_though_the_lease_takes_the_beam_off():
    results = drilled(beam_of(has_watchdog=False))
    assert failed(results) == {"fail_safe_watchdog_ms", "beam_readback_errors"}
    assert "lease ended" in results["fail_safe_watchdog_ms"].detail


@pytest.mark.parametrize("line", [DropsEarly, DeafToHolds])
def test_a_line_that_went_off_otherwise_proves_no_watchdog(line):
    # With so short a lease its end comes within the watchdog's bound.
    results = drilled(beam_of(line, pulse_ms=130.0))
    assert results["fail_safe_watchdog_ms"].value is None
    assert "watchdog" in results["fail_safe_watchdog_ms"].detail


@pytest.mark.parametrize("line", LINES, ids=lambda line: line.__name__)
def test_every_line_is_held_before_it_is_closed_and_off_at_the_end(line):
    given = beam_of(line)
    drill_line(given, lambda _done: None)
    calls = given.line.calls
    last_permit = max((n for n, what in enumerate(calls) if what == "permit"), default=-1)
    assert "hold" in calls[last_permit + 1 : len(calls) - calls[::-1].index("close")]
    assert calls.count("close") == 1
    given.wait_ns(NS_PER_S)
    assert not given.line.is_on()


@pytest.mark.parametrize("cancelled_at", range(0, 26, 3))
def test_a_drill_that_is_cancelled_ends_with_the_line_held_and_closed(cancelled_at):
    given = beam_of()

    class Cancelled(Exception):  # noqa: N818 - a caller's own
        pass

    def on_pulse(done):
        if done == cancelled_at:
            raise Cancelled

    with pytest.raises(Cancelled):
        drill_line(given, on_pulse)
    assert not given.line.is_on()
    assert given.line.calls[-2:] == ["close", "hold"]
    assert "permit" not in given.line.calls[-4:]


@pytest.mark.parametrize(("delay_ms", "fails"), [(20.0, False), (80.0, False), (180.0, True)])
def test_where_the_accelerator_delivers_the_time_to_its_beam_off_is_judged(delay_ms, fails):
    given = beam_of()
    accelerator = SimulatedAccelerator(given.line, given.clock, delay_ms=delay_ms)
    results = drilled(replace(given, beam_on=accelerator.read))
    assert results["hold_to_beam_off_ms"].value == pytest.approx(delay_ms, abs=2.0)
    assert failed(results) == ({"hold_to_beam_off_ms"} if fails else set())


def test_where_nothing_shows_the_beam_or_the_accelerator_is_off_it_is_not_judged():
    assert "hold_to_beam_off_ms" not in drilled(beam_of())
    given = beam_of()
    looks = []
    results = drilled(replace(given, beam_on=lambda: bool(looks.append(1))))
    assert "hold_to_beam_off_ms" not in results
    assert failed(results) == set()
    assert len(looks) < 1_100  # it is waited for once


def test_a_beam_that_does_not_go_off_fails_the_drill_and_is_named():
    results = drilled(replace(beam_of(), beam_on=lambda: True))
    assert "the accelerator reports beam on 1000 ms after the hold" in results["fail_safe_hold_ms"].detail
    assert {"fail_safe_hold_ms", "beam_readback_errors"} <= failed(results)


def test_progress_is_reported_after_every_drill():
    done = []
    drill_line(beam_of(repeats=6), done.append)
    assert done == list(range(6 * len(DRILLS) + 1))


def test_a_real_watchdog_in_its_own_thread_holds_the_line_in_real_time():
    clock = MonotonicClock()
    line = SimulatedBeamLine(clock)
    given = BeamInput(line=line, clock=clock, wait_ns=lambda ns: threading.Event().wait(ns / NS_PER_S), repeats=5)
    drill_line(given, lambda _done: None)
    assert HoldReason.WATCHDOG in {edge.reason for edge in line.edges}
    assert not line.is_on()


@pytest.mark.parametrize(
    ("field", "value"),
    [("pulse_ms", 250.0), ("pulse_ms", float("nan")), ("repeats", 4), ("watchdog_ms", 39.0), ("watchdog_ms", 101.0)],
)
def test_numbers_out_of_their_bounds_are_refused_by_name(field, value):
    clock = MonotonicClock()
    with pytest.raises(InvalidValueError) as refusal:
        BeamInput(line=SimulatedBeamLine(clock), clock=clock, wait_ns=lambda _ns: None, **{field: value})
    assert refusal.value.field == f"beam.{field}"
