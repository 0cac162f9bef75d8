"""What a turn reads: each field holds its own reading, and what has to be read late is read late."""

import threading
from concurrent.futures import Future
from dataclasses import replace
from unittest.mock import ANY

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.control.beam_driver import LineOrders
from engine.control.output_queues import OutputQueues
from engine.control.session_state import SessionLimits
from engine.control.turn_inputs import CommandInputs, CommandQueue, TurnReader
from engine.control.watchdog import Watchdog
from engine.core.clock import ManualClock
from engine.core.commands import Arm, Disarm, HoldBeam
from engine.core.errors import BeamLineError, FrameTimeoutError, SourceAwayError, SourceLostError
from engine.core.gate_state import GateState, HoldReason
from engine.gating.gate import Gate, Interruption, lease_of
from engine.gating.interlocks import MOST_PERSONS, DecisionInputs, OperatorPresence
from tests.support.control.armed_bench import ON, ON_AT, on_bench
from tests.support.control.loop_bench import (
    ScriptedSource,
    SteppedWatchdog,
    WatchedBeamLine,
    drained,
    good,
    raising as raising_step,
    silent,
)
from tests.support.gating.streams import LIMITS, MEASURING_NS, MS, PERIOD_NS, START_NS, stream_in


class Parts:
    """A reader, and everything that it reads."""

    def __init__(self, script=()):
        self.clock = ManualClock(START_NS)
        self.beam = WatchedBeamLine(self.clock)
        self.watchdog = SteppedWatchdog(beam=self.beam, clock=self.clock, deadline_ns=100 * MS)
        self.commands = CommandQueue(clock=self.clock, capacity=4)
        self.outputs = OutputQueues(sample_capacity=2, transition_capacity=12)
        self.presence = OperatorPresence(clock=self.clock, timeout_s=1.0)
        self.stop_requested = threading.Event()
        self.source = ScriptedSource(self.clock, script)
        self.reader = TurnReader(
            source=self.source,
            clock=self.clock,
            limits=SessionLimits(LIMITS),
            commands=self.commands,
            outputs=self.outputs,
            watchdog=self.watchdog,
            presence=self.presence,
            stop_requested=self.stop_requested,
        )
        self.line = LineOrders(self.beam, clock=self.clock, watchdog=self.watchdog)

    def fire(self):
        self.watchdog.feed(0, is_armed=True)
        assert self.watchdog.check(self.clock.now_ns())

    def fill_samples(self):
        bench = on_bench([good])
        record = bench.run().records()[0]
        self.outputs.put_sample(replace(record, asserted_ns=self.clock.now_ns()))

    def be_absent(self):
        self.presence.note("anna")
        self.clock.advance_ns(2_000 * MS)


ARMED = Gate(state=GateState.HOLD, reason=HoldReason.DWELL, armed_by="anna")
REPORTED = Interruption(HoldReason.DISK_LOW, "almost full")
CHANGES = {
    "watchdog_fired": (Parts.fire, True),
    "reported_fault": (lambda parts: parts.commands.report(REPORTED), REPORTED),
    "queue_trouble": (lambda parts: [parts.fill_samples() for _ in range(2)], HoldReason.RECORDER_BEHIND),
    "disarm_requested_by": (lambda parts: parts.commands.submit(Disarm(operator="anna")), "anna"),
    "hold_requested_by": (lambda parts: parts.commands.submit(HoldBeam(operator="bert")), "bert"),
    "is_stop_requested": (lambda parts: parts.stop_requested.set(), True),
}


@pytest.mark.parametrize("name", CHANGES)
def test_each_field_of_a_decision_holds_its_own_reading(name):
    change, value = CHANGES[name]
    parts = Parts()
    change(parts)
    now_ns = parts.clock.now_ns()
    assert parts.reader.decision(Gate()) == DecisionInputs(at_ns=now_ns, **{name: value})


@pytest.mark.parametrize(
    ("gate", "absence"),
    [
        (Gate(), ""),
        (ARMED, "no message from anna for 2.0 s"),
        (replace(ARMED, armed_by="bert"), "no message from bert"),
        (replace(ARMED, is_armed_by_program=True), "no person who may arm is at the page"),
    ],
)
def test_who_has_to_be_present_is_read_for_an_armed_gate(gate, absence):
    parts = Parts()
    assert parts.presence.absence(gate, parts.clock.now_ns()) == ("" if gate.armed_by is None else ANY)
    parts.be_absent()
    assert parts.reader.decision(gate) == DecisionInputs(at_ns=parts.clock.now_ns(), operator_absence=absence)
    parts.presence.note("carl" if gate.is_armed_by_program else str(gate.armed_by))
    assert parts.reader.decision(gate).operator_absence == ""


@pytest.mark.parametrize("is_person", [True, False])
def test_a_program_that_arms_reads_whether_a_person_is_present(is_person):
    parts = Parts()
    parts.be_absent()
    for absence in ("" if is_person else "no person who may arm is at the page", ""):
        parts.commands.submit(Arm(operator="key:tps", is_person=is_person))
        (taken,) = parts.reader.turn().commands
        found = parts.reader.command(taken)
        assert found == CommandInputs(is_watchdog_running=found.is_watchdog_running, operator_absence=absence)
        parts.presence.note("carl")


def test_more_persons_than_a_site_has_are_forgotten_and_not_kept_for_ever():
    parts = Parts()
    for number in range(MOST_PERSONS + 1):
        parts.presence.note(f"person {number}")
    assert len(parts.presence._seen_ns) == 1


def test_the_silence_of_the_service_is_a_fault_while_armed_only():
    parts = Parts()
    parts.commands.note_service(parts.clock.now_ns())
    parts.clock.advance_ns(MS)
    assert parts.reader.decision(Gate()).reported_fault is None
    assert parts.reader.decision(ARMED).reported_fault.reason is HoldReason.SERVICE_SILENT


def test_what_waits_too_long_for_the_disk_is_read_while_armed_only():
    parts = Parts()
    parts.fill_samples()
    parts.clock.advance_ns(int((LIMITS.max_unwritten_ms + 1) * MS))
    delay = (HoldReason.RECORDER_BEHIND, f"nothing was written for {LIMITS.max_unwritten_ms + 1:.0f} ms")
    assert parts.reader.decision(ARMED).write_delay == delay
    assert parts.reader.decision(Gate()).write_delay is None


def test_a_watchdog_whose_thread_is_gone_is_read():
    parts = Parts()
    parts.reader._watchdog = Watchdog(beam=parts.beam, clock=parts.clock, deadline_ns=MS)  # never started
    assert not parts.reader.decision(ARMED).is_watchdog_running
    queued = parts.commands.submit(Arm(operator="anna"))
    (taken,) = parts.reader.turn().commands
    assert taken.answer is queued
    assert parts.reader.command(taken) == CommandInputs(is_watchdog_running=False)


def test_a_command_whose_caller_has_given_up_is_not_wanted_and_a_full_queue_is_its_trouble():
    parts = Parts()
    [parts.fill_samples() for _ in range(2)]
    answer: Future[None] = parts.commands.submit(Arm(operator="anna"))
    answer.cancel()
    (taken,) = parts.reader.turn().commands
    assert parts.reader.command(taken) == CommandInputs(is_wanted=False, queue_trouble=HoldReason.RECORDER_BEHIND)


def test_a_stop_takes_no_commands():
    parts = Parts()
    parts.commands.submit(Arm(operator="anna"))
    parts.stop_requested.set()
    turn = parts.reader.turn()
    assert (turn.is_stop_requested, turn.commands) == (True, ())
    assert len(parts.commands.take()) == 1, "they are refused when the session ends"


def test_a_source_answers_with_a_frame_or_none_in_time_or_is_away():
    parts = Parts([good, silent, raising_step(SourceAwayError("unplugged")), raising_step(SourceLostError("gone"))])
    frame = parts.reader.frame(last_received_ns=None)
    assert (frame.frame.index, frame.away, frame.at_ns) == (0, None, START_NS + PERIOD_NS - MEASURING_NS)
    late = parts.reader.frame(last_received_ns=None)
    assert (late.frame, late.away, late.at_ns) == (None, None, frame.at_ns + int(LIMITS.max_gap_ms * MS))
    away = parts.reader.frame(last_received_ns=None)
    assert (away.frame, away.away) == (None, "unplugged")
    with pytest.raises(SourceLostError, match="gone"):
        parts.reader.frame(last_received_ns=None)


@pytest.mark.parametrize(
    ("since_last_ms", "left_ms"),
    [(0, LIMITS.max_gap_ms), (LIMITS.max_gap_ms - 10, 10), (LIMITS.max_gap_ms + 10, LIMITS.max_gap_ms)],
)
def test_a_frame_is_waited_for_until_it_is_late_against_the_last_one(since_last_ms, left_ms):
    waited = []

    def step(_source, timeout_s):
        waited.append(timeout_s)
        raise FrameTimeoutError

    parts = Parts([step])
    parts.reader.frame(last_received_ns=START_NS - int(since_last_ms * MS))
    assert waited == [pytest.approx(left_ms / 1000)]


def test_transitions_that_did_not_fit_are_offered_again_at_the_next_decision():
    bench = on_bench([good])
    change = bench.run().transitions()[0]
    parts = Parts()
    for _ in range(parts.outputs.transitions.maxsize + 1):
        parts.outputs.put_transition(change)
    assert parts.outputs.kept_transitions == 1
    drained(parts.outputs.transitions)  # by a reader that holds the queue itself
    assert parts.reader.decision(Gate()).queue_trouble is None
    assert (parts.outputs.kept_transitions, parts.outputs.transitions.qsize()) == (0, 1)


# The beam line.


def lease(parts):
    gate = stream_in(GateState.BEAM_ON).gate
    gate = replace(gate, last=replace(gate.last, received_ns=parts.clock.now_ns()))
    return lease_of(gate, decided_ns=parts.clock.now_ns(), sequence=1, limits=LIMITS)


def connected():
    parts = Parts()
    parts.line.connect()
    parts.line.rearm()
    parts.clock.advance_ns(MS)
    return parts


def test_a_line_is_read_back_after_the_order_and_the_time_after_that():
    parts = connected()
    parts.beam.before_permit = lambda _lease: parts.clock.advance_ns(7 * MS)
    answer = parts.line.permit(lease(parts))
    assert (answer.is_on, answer.error, answer.at_ns) == (True, None, START_NS + 8 * MS)
    answer = parts.line.hold(HoldReason.DWELL)
    assert (answer.is_on, answer.error) == (False, None)


def test_a_watchdog_that_fires_during_an_order_is_in_its_answer():
    parts = connected()
    parts.beam.before_permit = lambda _lease: parts.fire()
    answer = parts.line.permit(lease(parts))
    assert (answer.watchdog_fired, isinstance(answer.error, BeamLineError)) == (True, True)


def test_an_error_of_a_line_is_its_answer_except_where_it_cannot_be_connected(monkeypatch):
    parts = connected()

    def fails(*_arguments):
        raise BeamLineError("no")

    monkeypatch.setattr(WatchedBeamLine, "is_on", fails)
    answer = parts.line.hold(HoldReason.DWELL)
    assert (answer.is_on, str(answer.error)) == (True, "no"), "it may be on"
    assert parts.line.hold_again(HoldReason.DWELL).error is None, "it was not read back"
    for name in ("open", "rearm", "hold"):
        monkeypatch.setattr(SimulatedBeamLine, name, fails)
    for order in (parts.line.connect, parts.line.rearm):
        with pytest.raises(BeamLineError, match="no"):
            order()


def test_a_line_is_held_when_it_is_connected():
    parts = Parts()
    parts.line.connect()
    assert not parts.beam.is_on()
    held = []
    parts.beam.hold = held.append
    parts.line.connect()
    assert held == [HoldReason.DISARMED]


# Late readings: what happens while a frame is measured counts at that frame's decision.


def measured_meanwhile(act):
    """Run a bench whose beam is on, and let something happen while the next frame is measured."""
    bench = on_bench([good] * 4)

    def meanwhile(frame):
        act(bench)
        return frame

    bench.pipeline.spoil[ON + 1] = meanwhile
    records = bench.run().records()
    assert records[ON].line_on
    return bench, records[ON + 1]


def test_the_time_of_a_decision_includes_the_measuring():
    _bench, record = measured_meanwhile(lambda bench: bench.clock.advance_ns(5 * MS))
    assert record.decided_ns == record.received_ns + MEASURING_NS + 5 * MS


@pytest.mark.parametrize("command", [Disarm(operator="anna"), HoldBeam(operator="anna")])
def test_a_disarm_or_hold_that_is_requested_during_the_measuring_counts_at_once(command):
    bench, record = measured_meanwhile(lambda bench: bench.loop.submit(command))
    reason = HoldReason.DISARMED if isinstance(command, Disarm) else HoldReason.OPERATOR_HOLD
    assert (record.line_on, record.gate_state, record.hold_reason) == (False, GateState.HOLD, reason)
    change = next(one for one in bench.transitions() if one.frame_index == ON + 1)
    assert "anna" in (change.operator or change.detail)


def test_a_stop_that_is_requested_during_the_measuring_counts_at_once():
    _bench, record = measured_meanwhile(lambda bench: bench.loop._stop_requested.set())
    assert (record.line_on, record.hold_reason) == (False, HoldReason.ENGINE_STOPPED)


def test_a_fault_that_is_reported_during_the_measuring_counts_at_once():
    _bench, record = measured_meanwhile(lambda bench: bench.loop.report_fault(HoldReason.DISK_LOW, "full"))
    assert (record.line_on, record.hold_reason) == (False, HoldReason.DISK_LOW)


def test_a_lease_is_checked_against_the_time_after_the_permit_was_prepared(monkeypatch):
    """The journal may take long: a permit whose lease has ended by then is not ordered."""
    bench = on_bench([good])
    prepare = bench.loop._outputs.prepare

    def slowly(transition):
        bench.clock.advance_ns(int(LIMITS.lease_ms * MS))
        return prepare(transition)

    monkeypatch.setattr(bench.loop._outputs, "prepare", slowly)
    records = bench.run().records()
    assert bench.beam.permits == []
    assert (records[ON_AT].line_on, records[ON_AT].hold_reason) == (False, HoldReason.FRAME_LATE)
