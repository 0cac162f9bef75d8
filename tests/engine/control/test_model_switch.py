"""A new model never takes over under an armed gate; a person may let it, which disarms; all of it is reported."""

import pytest

from engine.control.output_queues import NOTICE_CAPACITY
from engine.core.commands import ApplyModel, Disarm, Retrain
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from engine.core.learning_status import LearningEvent, LearningEventKind
from tests.support.control.armed_bench import LEARNED, ON_AT, armed_bench
from tests.support.control.loop_bench import Bench, after, drained, good

OPERATOR = "ann"


def notice(number: int = 0) -> LearningEvent:
    return LearningEvent(kind=LearningEventKind.READY, detail="ready", timestamp_us=number, figures={"frames": number})


def test_the_pipeline_gets_before_every_frame_whether_an_armed_gate_decides_by_its_model():
    bench = armed_bench([*[good] * 6])
    bench.source.script += [after(bench.ask(Disarm(operator=OPERATOR))), *[good] * 3]
    records = bench.run().records()
    assert len(bench.pipeline.was_kept) == len(records)
    armed_at_decision = [record.gate_state is not GateState.DISARMED for record in records]
    # Armed or disarmed between two frames counts for the second of them.
    assert bench.pipeline.was_kept == armed_at_decision
    assert bench.pipeline.was_kept[LEARNED : LEARNED + 2] == [False, True]


def test_a_model_that_waits_leaves_the_beam_on_until_it_is_applied_which_disarms_first():
    bench = armed_bench([*[good] * 6])
    bench.pipeline.is_model_waiting = True
    line_when_applied = []
    change = bench.pipeline._change

    def noted(name):
        line_when_applied.append(bench.beam.is_on())
        change(name)

    bench.pipeline._change = noted
    bench.source.script += [after(bench.ask(ApplyModel(operator=OPERATOR))), *[good] * 4]
    records = bench.run().records()
    assert bench.answers[-1].result(timeout=0) is None
    assert records[ON_AT + 2].line_on
    assert line_when_applied == [False]
    assert {record.gate_state for record in records[-4:]} == {GateState.DISARMED}
    disarmed = next(each for each in bench.transitions() if each.to_state is GateState.DISARMED)
    assert (disarmed.operator, disarmed.detail) == (OPERATOR, "a new model is applied")


def test_applying_what_does_not_wait_is_refused_and_does_not_disturb_the_beam():
    bench = armed_bench([*[good] * 6])
    bench.source.script += [after(bench.ask(ApplyModel(operator=OPERATOR))), *[good] * 3]
    records = bench.run().records()
    assert isinstance(bench.answers[-1].exception(timeout=0), CommandRefusedError)
    assert bench.pipeline.calls == []
    assert records[-1].line_on


def test_after_a_model_was_applied_the_gate_has_to_be_armed_anew():
    bench = armed_bench([*[good] * 6])
    bench.pipeline.is_model_waiting = True
    bench.source.script += [after(bench.ask(ApplyModel(operator=OPERATOR))), *[good] * 30]
    records = bench.run().records()
    assert not any(record.line_on for record in records[ON_AT + 4 :])


@pytest.mark.parametrize(("keeps_reference", "call"), [(True, "retrain"), (False, "retrain without zero")])
def test_whether_the_reference_is_kept_reaches_the_pipeline(keeps_reference, call):
    bench = Bench([good] * 3)
    bench.source.script += [after(bench.ask(Retrain(operator=OPERATOR, keeps_zero=keeps_reference))), good]
    bench.run()
    assert bench.pipeline.calls == [call]


def test_what_the_learning_reports_leaves_in_order_and_none_is_lost():
    bench = Bench([good] * 8)
    take = bench.pipeline.take_notices
    numbers = iter(range(1000))
    bench.pipeline.take_notices = lambda: [*take(), notice(next(numbers)), notice(next(numbers))]
    bench.run()
    assert [reported.timestamp_us for reported in drained(bench.loop.notices)] == list(range(16))


def test_notices_that_are_not_taken_hold_with_a_fault_and_are_offered_again():
    bench = armed_bench([*[good] * 8])
    bench.source.script += [after(lambda: bench.pipeline.notices.extend(map(notice, range(NOTICE_CAPACITY + 5))))]
    bench.source.script += [good] * 3
    records = bench.run().records()
    assert not records[-1].line_on
    assert any(change.reason is HoldReason.AUDIT_BEHIND for change in bench.transitions())
    first = drained(bench.loop.notices)
    assert [reported.timestamp_us for reported in [*first, *drained(bench.loop.notices)]] == list(
        range(NOTICE_CAPACITY + 5)
    )
