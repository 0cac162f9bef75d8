"""Full queues hold the beam and lose no transition; nothing in the engine waits for who empties them."""

import pytest

from engine.control.output_queues import RESERVED_TRANSITIONS, OutputQueues
from engine.control.outputs import GateTransition
from engine.core.commands import Acknowledge, Arm
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import ON_AT, armed_bench
from tests.support.control.loop_bench import MS, PERIOD_NS, Bench, after, drained, good
from tests.support.gating.streams import unmeasured

from engine.core.frames import MeasurementState  # isort: skip


def _transition(number: int) -> GateTransition:
    return GateTransition(
        at_ns=number,
        frame_index=None,
        from_state=GateState.HOLD,
        to_state=GateState.DWELL,
        reason=HoldReason.DWELL,
        operator=None,
        detail="",
        captured_us=None,
        received_ns=None,
        decided_ns=number,
        asserted_ns=number,
    )


def test_a_recorder_that_falls_behind_holds_with_a_fault():
    bench = armed_bench([good] * 20, sample_capacity=12).run()
    records = bench.records()
    assert len(records) == 12
    assert records[-1].line_on
    behind = next(change for change in bench.transitions() if change.to_state is GateState.FAULT)
    assert (behind.reason, behind.frame_index) == (HoldReason.RECORDER_BEHIND, 12)
    assert bench.beam.edges[1].at_ns == behind.decided_ns
    assert bench.loop.status.view.dropped_records == 24 - 12


def test_no_frame_is_permitted_that_could_not_be_recorded():
    bench = armed_bench([good] * 20, sample_capacity=12).run()
    recorded = {record.received_ns for record in bench.records()}
    assert bench.beam.permits
    assert {lease.expires_ns - 80_000_000 for lease in bench.beam.permits} <= recorded


def test_an_audit_that_falls_behind_holds_with_a_fault_and_no_transition_is_lost():
    bench = armed_bench([good] * 60, transition_capacity=4)
    for index in range(ON_AT + 2, 60, 6):
        bench.pipeline.spoil[index] = lambda frame: unmeasured(frame, MeasurementState.TRAINING)
    bench.run()
    path = bench.path()
    assert "fault:audit_behind" in path
    assert path[:5] == ["hold:dwell", "dwell:dwell", "beam_on:", "hold:training", "fault:audit_behind"]
    assert bench.beam.edges[-1].is_on is False
    assert len(bench.beam.edges) == 2


def test_transitions_that_found_the_queue_full_are_offered_again_in_order():
    outbox = OutputQueues(sample_capacity=1, transition_capacity=2)
    for number in range(20):
        outbox.put_transition(_transition(number))
    assert outbox.kept_transitions == 20 - 2 - RESERVED_TRANSITIONS
    seen = []
    while outbox.kept_transitions or not outbox.transitions.empty():
        seen += [change.at_ns for change in drained(outbox.transitions)]
        outbox.flush()
    assert seen == list(range(20))


def test_a_reader_gets_every_transition_although_the_engine_ended_with_a_full_queue():
    bench = Bench([good] * 3, transition_capacity=4).run()
    drained(bench.loop.transitions)
    for number in range(30):
        bench.loop._outputs.put_transition(_transition(number))
    seen = []
    while not bench.loop.transitions.empty():
        seen += [change.at_ns for change in drained(bench.loop.transitions)]
    assert seen == list(range(30))


def test_the_audit_is_behind_while_there_is_still_room_for_telling_so():
    outbox = OutputQueues(sample_capacity=1, transition_capacity=2)
    outbox.put_transition(_transition(0))
    assert outbox.trouble() is None
    outbox.put_transition(_transition(1))
    assert outbox.trouble() is HoldReason.AUDIT_BEHIND
    assert not outbox.transitions.full()


def test_the_fault_cannot_be_acknowledged_while_nothing_can_be_recorded():
    bench = armed_bench([*[good] * 12], sample_capacity=12)
    bench.source.script += [after(bench.ask(Acknowledge(operator="ann"))), good]
    bench.run()
    error = bench.answers[-1].exception(timeout=0)
    assert isinstance(error, CommandRefusedError)
    assert "recorder_behind" in str(error)


def test_once_the_queue_is_emptied_a_person_can_go_on():
    bench = armed_bench([*[good] * 12], sample_capacity=14)
    bench.source.script += [
        after(lambda: drained(bench.loop.samples)),
        after(bench.ask(Acknowledge(operator="ann"))),
        after(bench.ask(Arm(operator="ann"))),
        *[good] * 6,
    ]
    bench.run()
    assert [answer.exception(timeout=0) for answer in bench.answers] == [None] * 3
    assert bench.records()[-1].line_on


def test_a_writer_that_hangs_holds_with_a_fault_within_a_second_although_no_queue_is_full():
    """What was on when it began to hang could be lost for so long, and no longer."""
    bench = armed_bench([good] * 60, is_written=False).run()
    behind = next(change for change in bench.transitions() if change.to_state is GateState.FAULT)
    assert behind.reason is HoldReason.RECORDER_BEHIND
    assert "nothing was written for 1" in behind.detail
    first_ns = bench.records()[0].asserted_ns
    assert bench.beam.edges[-1].is_on is False
    assert bench.beam.edges[-1].at_ns - first_ns <= 1_000 * MS + 2 * PERIOD_NS


def test_transitions_that_wait_too_long_are_the_audit_s_trouble():
    bench = armed_bench([], is_written=False)
    bench.source.script += [step for _ in range(40) for step in (after(lambda: drained(bench.loop.samples)), good)]
    bench.run()
    behind = next(change for change in bench.transitions() if change.to_state is GateState.FAULT)
    assert behind.reason is HoldReason.AUDIT_BEHIND


def test_an_unarmed_gate_faults_for_nothing_that_waits_and_arming_it_then_faults_at_once():
    bench = Bench([good] * 60, is_written=False)
    bench.source.script += [after(bench.ask(Arm(operator="ann"))), good]
    bench.run()
    assert bench.answers[0].exception(timeout=0) is None
    assert "fault:recorder_behind" in bench.path()
    assert bench.beam.permits == []


@pytest.mark.parametrize("capacity", [1, 2])
def test_the_smallest_queues_never_stop_the_engine(capacity):
    bench = Bench([good] * 30, sample_capacity=capacity, transition_capacity=capacity).run()
    assert bench.loop.status.view.frames == 30


def test_what_waits_as_long_as_it_may_is_no_delay_and_a_longer_wait_names_its_length():
    outbox = OutputQueues(sample_capacity=1, transition_capacity=2)
    outbox.put_transition(_transition(7))
    assert outbox.delay(7 + 20 * MS, 20 * MS) is None
    assert outbox.delay(8 + 20 * MS, 20 * MS) == (HoldReason.AUDIT_BEHIND, "nothing was written for 20 ms")
