"""The line's driver by itself: what is permitted, and when a permit comes too late to be one."""

from dataclasses import replace

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import ManualClock
from engine.core.errors import BeamLineError, BeamLineMismatchError
from engine.core.gate_state import GateState, HoldReason
from engine.gating.gate import Interruption
from tests.support.control.loop_bench import WatchedBeamLine, driver_of
from tests.support.gating.streams import LIMITS, MS, PERIOD_NS, stream_in

LEASE_NS = int(LIMITS.lease_ms * MS)


def received(gate, at_ns):
    """The same gate, its newest frame received then."""
    return replace(gate, last=replace(gate.last, received_ns=at_ns))


@pytest.mark.parametrize(("reported_ns", "is_on"), [(LEASE_NS - 1, True), (LEASE_NS, False)])
def test_a_decision_in_time_that_is_reported_once_the_line_has_gone_off_by_itself_holds_and_costs_a_dwell(
    reported_ns, is_on
):
    """The gate found its lease alive when it decided; the line had lapsed when it was reported."""
    gate = stream_in(GateState.BEAM_ON).gate
    first_ns = gate.last.received_ns
    clock = ManualClock(first_ns)
    beam = SimulatedBeamLine(clock)
    beam.open()
    beam.rearm()
    driver = driver_of(beam, clock)
    assert driver.carry_out(gate, clock.now_ns()).is_on
    clock.advance_ns(reported_ns)
    report = driver.carry_out(received(gate, first_ns + PERIOD_NS), first_ns + PERIOD_NS + 1)
    assert report.is_on is is_on
    assert beam.is_on() is is_on
    assert (report.trouble is None) is is_on
    if report.trouble is not None:
        assert report.trouble == Interruption(HoldReason.FRAME_LATE, "the lease before had lapsed in the line")


def test_an_order_that_reaches_the_line_after_the_lapse_holds_without_a_fault_and_never_turns_it_on():
    """Checked in time; the thread was stopped before the line had the order, and the line has gone off meanwhile."""
    gate = stream_in(GateState.BEAM_ON).gate
    clock = ManualClock(gate.last.received_ns)
    beam = SimulatedBeamLine(clock)
    beam.open()
    beam.rearm()
    driver, permit = driver_of(beam, clock), beam.permit
    driver.carry_out(gate, clock.now_ns())
    clock.advance_ns(PERIOD_NS)
    beam.permit = lambda lease: (clock.advance_ns(LEASE_NS - PERIOD_NS), permit(lease))
    report = driver.carry_out(received(gate, clock.now_ns()), clock.now_ns())
    assert not report.is_on
    assert report.trouble == Interruption(HoldReason.FRAME_LATE, "the lease before had lapsed in the line")
    assert [edge.is_on for edge in beam.edges] == [True, False]


def test_after_a_hold_the_lease_of_before_states_nothing():
    gate = stream_in(GateState.BEAM_ON).gate
    clock = ManualClock(gate.last.received_ns)
    beam = SimulatedBeamLine(clock)
    beam.open()
    beam.rearm()
    driver = driver_of(beam, clock)
    driver.carry_out(gate, clock.now_ns())
    driver.carry_out(replace(gate, state=GateState.HOLD, reason=HoldReason.MARKER_LOST), clock.now_ns())
    clock.advance_ns(2 * LEASE_NS)
    assert driver.carry_out(received(gate, clock.now_ns()), clock.now_ns()).is_on


class Answering(SimulatedBeamLine):
    """Raises this error at each order but a hold, or stays off though permitted, or stays on though held."""

    error: Exception | None = None
    is_deaf = is_stuck = False

    def permit(self, lease):
        if self.error is not None:
            raise self.error
        if not self.is_deaf:
            super().permit(lease)

    def is_on(self):
        return self.is_stuck or super().is_on()


@pytest.mark.parametrize(
    ("line", "state", "trouble"),
    [
        (
            {"error": BeamLineError("no answer")},
            GateState.BEAM_ON,
            Interruption(HoldReason.BEAM_LINE_FAILED, "no answer"),
        ),
        ({"error": BeamLineError()}, GateState.BEAM_ON, Interruption(HoldReason.BEAM_LINE_FAILED, "BeamLineError")),
        (
            {"error": BeamLineMismatchError("off for 160 ms")},
            GateState.BEAM_ON,
            Interruption(HoldReason.BEAM_LINE_MISMATCH, "off for 160 ms"),
        ),
        (
            {"is_deaf": True},
            GateState.BEAM_ON,
            Interruption(HoldReason.BEAM_LINE_MISMATCH, "the line is off, though permitted"),
        ),
        (
            {"is_stuck": True},
            GateState.HOLD,
            Interruption(HoldReason.BEAM_LINE_MISMATCH, "the line is on, though held"),
        ),
    ],
    ids=["error", "error without text", "mismatch of its own", "off", "on"],
)
def test_the_trouble_of_a_line_names_its_kind_and_states_what_the_line_stated(line, state, trouble):
    gate = stream_in(GateState.BEAM_ON).gate
    clock = ManualClock(gate.last.received_ns)
    beam = Answering(clock)
    beam.open()
    beam.rearm()
    for name, value in line.items():
        setattr(beam, name, value)
    report = driver_of(beam, clock).carry_out(replace(gate, state=state), clock.now_ns())
    assert report.trouble == trouble
    assert not report.is_settling


def test_a_decision_that_outlived_its_lease_or_a_line_that_answered_after_it_states_it():
    gate = stream_in(GateState.BEAM_ON).gate
    for late_ns, detail in (
        (LEASE_NS, "the decision took longer than its lease"),
        (0, "the lease lapsed before the line had answered"),
    ):
        clock = ManualClock(gate.last.received_ns)
        beam = WatchedBeamLine(clock)
        beam.open()
        beam.rearm()
        beam.before_permit = lambda _lease, of=clock: of.advance_ns(LEASE_NS)
        decided_ns = clock.now_ns()
        clock.advance_ns(late_ns)
        report = driver_of(beam, clock).carry_out(gate, decided_ns)
        assert (report.is_on, report.trouble) == (False, Interruption(HoldReason.FRAME_LATE, detail))


class Settling(SimulatedBeamLine):
    """Reads back the contrary of its command, and says that it settles."""

    is_settling = True

    def is_on(self):
        return not super().is_on()


@pytest.mark.parametrize(("line", "is_settling"), [(SimulatedBeamLine, False), (Settling, True)])
@pytest.mark.parametrize("state", [GateState.BEAM_ON, GateState.HOLD])
def test_the_report_states_whether_the_order_may_not_have_taken_effect(line, is_settling, state):
    gate = stream_in(GateState.BEAM_ON).gate
    clock = ManualClock(gate.last.received_ns)
    beam = line(clock)
    beam.open()
    beam.rearm()
    report = driver_of(beam, clock).carry_out(replace(gate, state=state), clock.now_ns())
    assert (report.is_on, report.is_settling) == ((state is GateState.BEAM_ON) is not is_settling, is_settling)
    assert report.trouble is None
