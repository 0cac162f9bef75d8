"""What may be asked of a running engine, when it is refused, and that the line is commanded before the asker is."""

from dataclasses import replace

import pytest

from engine.control.outputs import LoopStatus
from engine.core.commands import Acknowledge, ActivateModel, Disarm, Retrain, SetReference
from engine.core.errors import CommandRefusedError, ModelError
from engine.core.frames import LostReason, MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.windows import amplitude_window
from tests.support.control.armed_bench import ARM, LEARNED, armed_bench
from tests.support.control.loop_bench import Bench, after, good, silent
from tests.support.gating.streams import LIMITS, MS, unmeasured

OPERATOR = "ann"


def _refusal(bench: Bench, number: int = -1) -> str:
    error = bench.answers[number].exception(timeout=0)
    assert isinstance(error, CommandRefusedError)
    return str(error)


def _is_off(bench: Bench) -> bool:
    return not bench.beam.permits and not any(record.line_on for record in bench.records())


def test_arming_is_refused_before_any_frame():
    bench = Bench([])
    bench.source.script = [after(lambda: None)]
    bench.ask(ARM)()
    bench.run()
    assert "newest frame was not measured" in _refusal(bench)


@pytest.mark.parametrize(
    ("attribute", "value", "sentence"),
    [
        ("model", None, "no motion model"),
        ("has_reference", False, "no reference"),
        ("model_shortcoming", "two cycles only", "two cycles only"),
    ],
)
def test_arming_is_refused_without_a_model_or_a_reference(attribute, value, sentence):
    bench = armed_bench([good] * 8)
    setattr(bench.pipeline, attribute, value)
    assert sentence in _refusal(bench.run())
    assert _is_off(bench)


@pytest.mark.parametrize(
    ("state", "lost"), [(MeasurementState.TRAINING, None), (MeasurementState.LOST, LostReason.MARKER_LOST)]
)
def test_arming_is_refused_while_the_newest_frame_is_not_measured(state, lost):
    bench = armed_bench([good] * 8)
    bench.pipeline.spoil[LEARNED] = lambda frame: unmeasured(frame, state, lost)
    assert "not measured" in _refusal(bench.run())
    assert _is_off(bench)


def test_arming_is_refused_on_an_old_frame():
    bench = Bench([good] * 3)
    bench.source.script += [silent, silent, silent, after(bench.ask(ARM)), good]
    bench.run()
    assert bench.answers[0].exception(timeout=0) is None  # the frame delivered after asking was fresh
    bench = Bench([good] * 3)

    def ask_then_nothing(source, timeout_s):
        bench.ask(ARM)()
        return silent(source, timeout_s)

    bench.source.script += [silent, silent, ask_then_nothing, good]
    assert "ms old" in _refusal(bench.run())


def test_arming_is_refused_where_the_gated_region_is_not_measured():
    window = amplitude_window(signal="region", row=13, column=7, lower_mm=-1.0, upper_mm=3.0)
    bench = armed_bench([good] * 8, limits=replace(LIMITS, window=window)).run()
    assert bench.answers[0].exception(timeout=0) is None
    outside = replace(window, choice=replace(window.choice, row=14))
    bench = armed_bench([good] * 8, limits=replace(LIMITS, window=outside)).run()
    assert "acknowledge" in _refusal(bench)  # a signal that is no number has faulted the gate already
    assert _is_off(bench)


def test_arming_is_refused_right_after_acknowledging_what_the_newest_frame_still_lacks():
    window = amplitude_window(signal="region", row=14, column=7, lower_mm=-1.0, upper_mm=3.0)
    bench = Bench([good] * 3, limits=replace(LIMITS, window=window))

    def acknowledge_and_arm():
        bench.ask(Acknowledge(operator=OPERATOR))()
        bench.ask(ARM)()

    bench.source.script += [after(acknowledge_and_arm), *[good] * 3]
    bench.run()
    assert bench.answers[0].exception(timeout=0) is None
    assert "gated motion is not measured" in _refusal(bench)


def test_a_fault_that_comes_up_with_an_acknowledgement_is_not_cleared_by_it():
    bench = armed_bench([*[good] * 6])

    def ask():
        bench.ask(Retrain(operator=OPERATOR))()  # whose obeying lets the fault in, just before the other
        bench.ask(Acknowledge(operator=OPERATOR))()

    bench.pipeline.retrain = lambda **_: bench.loop.report_fault(HoldReason.DISK_LOW, "10 MB left")
    bench.source.script += [
        after(lambda: bench.loop.report_fault(HoldReason.DISK_LOW, "20 MB left")),
        after(ask),
        *[good] * 3,
    ]
    bench.run()
    assert {record.gate_state for record in bench.records()[-3:]} == {GateState.FAULT}


def test_arming_twice_is_refused_and_does_not_disturb_the_beam():
    bench = armed_bench([*[good] * 6])
    bench.source.script += [after(bench.ask(ARM)), *[good] * 3]
    records = bench.run().records()
    assert "armed already" in _refusal(bench)
    assert all(record.line_on for record in records[-3:])


def test_arming_is_refused_while_a_fault_is_latched():
    bench = armed_bench([*[good] * 6])
    tell = bench.loop.report_fault
    bench.source.script += [after(lambda: tell(HoldReason.DISK_LOW, "")), after(bench.ask(ARM)), good]
    assert "disk_low" in _refusal(bench.run())


def test_arming_is_refused_without_a_watchdog():
    bench = armed_bench([good] * 8)
    bench.watchdog.__class__ = type("Dead", (type(bench.watchdog),), {"is_watching": property(lambda _self: False)})
    assert "watchdog" in _refusal(bench.run())
    assert _is_off(bench)


def test_acknowledging_nothing_is_refused():
    bench = Bench([good] * 3)
    bench.source.script += [after(bench.ask(Acknowledge(operator=OPERATOR))), good]
    assert "no fault" in _refusal(bench.run())


@pytest.mark.parametrize(
    "command",
    [Disarm(operator=OPERATOR), SetReference(operator=OPERATOR), ActivateModel(operator=OPERATOR, model=object())],
    ids=lambda command: type(command).__name__,
)
def test_the_line_is_off_and_the_gate_disarmed_before_the_caller_is_answered(command):
    bench = armed_bench([*[good] * 6])
    at_answer = []

    def ask():
        assert bench.beam.is_on()
        answer = bench.loop.submit(command)
        answer.add_done_callback(lambda _: at_answer.append((bench.beam.is_on(), bench.loop.gate.state)))

    bench.source.script += [after(ask), *[good] * 8]
    records = bench.run().records()
    assert at_answer == [(False, GateState.DISARMED)]
    assert {record.gate_state for record in records[LEARNED + 8 :]} == {GateState.DISARMED}
    disarmed = next(change for change in bench.transitions() if change.to_state is GateState.DISARMED)
    assert disarmed.operator == OPERATOR


def test_the_line_is_off_before_a_new_reference_or_model_is_touched():
    for command in (SetReference(operator=OPERATOR), ActivateModel(operator=OPERATOR, model=object())):
        bench = armed_bench([*[good] * 6])
        line_when_called = []
        change = bench.pipeline._change

        def noted(name, change=change, bench=bench, seen=line_when_called):
            seen.append(bench.beam.is_on())
            change(name)

        bench.pipeline._change = noted
        bench.source.script += [after(bench.ask(command)), good]
        bench.run()
        assert line_when_called == [False]


def test_retraining_goes_on_behind_an_armed_gate_until_the_model_is_swapped():
    bench = armed_bench([*[good] * 6])
    bench.source.script += [after(bench.ask(Retrain(operator=OPERATOR))), *[good] * 3]
    records = bench.run().records()
    assert bench.pipeline.calls == ["retrain"]
    assert records[-1].line_on


def test_what_the_pipeline_refuses_reaches_the_asker_and_leaves_the_gate_disarmed():
    bench = armed_bench([*[good] * 6])
    bench.pipeline.trouble = ModelError("made for another camera")
    command = ActivateModel(operator=OPERATOR, model=object())
    bench.source.script += [after(bench.ask(command)), *[good] * 3]
    bench.run()
    assert isinstance(bench.answers[-1].exception(timeout=0), ModelError)
    assert bench.loop.status.run_state is LoopStatus.ENDED
    assert bench.records()[-1].gate_state is GateState.DISARMED


def test_a_bug_behind_a_command_holds_reports_the_asker_and_fails_the_session():
    bench = armed_bench([*[good] * 6])
    bench.pipeline.trouble = ZeroDivisionError("oh")
    bench.source.script += [after(bench.ask(SetReference(operator=OPERATOR))), *[good] * 3]
    bench.run()
    assert isinstance(bench.answers[-1].exception(timeout=0), ZeroDivisionError)
    assert (bench.loop.status.run_state, bench.loop.gate.reason) == (LoopStatus.FAILED, HoldReason.ENGINE_FAILED)
    assert bench.beam.edges[-1].is_on is False


def test_a_command_that_raised_is_answered_once_the_line_is_off():
    bench = armed_bench([*[good] * 6])
    at_answer = []

    def fail(**_):
        assert bench.beam.is_on()
        raise ZeroDivisionError("oh")

    def ask():
        bench.loop.submit(Retrain(operator="eve")).add_done_callback(lambda _: at_answer.append(bench.beam.is_on()))

    bench.pipeline.retrain = fail
    bench.source.script += [after(ask), good]
    bench.run()
    assert at_answer == [False]


def test_a_flood_of_commands_is_refused_at_once_beyond_its_bound_and_all_are_answered():
    bench = armed_bench([*[good] * 6], command_capacity=5)
    refused = []

    def flood():
        for _ in range(200):
            try:
                bench.ask(Retrain(operator="eve"))()
            except CommandRefusedError as error:
                refused.append(str(error))

    bench.source.script += [after(flood), *[good] * 3]
    records = bench.run().records()
    assert len(refused) == 195
    assert all("5 commands wait" in sentence for sentence in refused)
    assert len([answer for answer in bench.answers if answer.done()]) == 1 + 5
    assert records[-1].line_on


def test_a_disarming_is_never_refused_however_many_wait():
    bench = armed_bench([*[good] * 6], command_capacity=1)

    def flood():
        bench.ask(Retrain(operator="eve"))()
        for _ in range(50):
            bench.ask(Disarm(operator="ann"))()

    bench.source.script += [after(flood), *[good] * 8]
    records = bench.run().records()
    assert all(answer.exception(timeout=0) is None for answer in bench.answers)
    assert {record.gate_state for record in records[-8:]} == {GateState.DISARMED}
    assert bench.pipeline.calls == ["retrain"]


def test_a_disarming_takes_back_an_arming_asked_for_before_it():
    bench = Bench([good] * 3)

    def arm_then_disarm():
        bench.ask(ARM)()
        bench.ask(Disarm(operator="bob"))()

    bench.source.script += [after(arm_then_disarm), *[good] * 8]
    bench.run()
    assert "disarmed before" in _refusal(bench, 0)
    assert bench.answers[1].result(timeout=0) is None
    assert _is_off(bench)


def test_an_arming_asked_for_after_a_disarming_counts():
    bench = Bench([good] * 3)

    def disarm_then_arm():
        bench.ask(Disarm(operator="bob"))()
        bench.ask(ARM)()

    bench.source.script += [after(disarm_then_arm), *[good] * 8]
    bench.run()
    assert bench.records()[-1].line_on


def test_a_command_that_waited_too_long_is_refused_but_a_disarming_is_not():
    bench = Bench([good] * 3)

    def ask_and_hang(source, timeout_s):
        bench.ask(ARM)()
        source.clock.advance_ns(1_001 * MS)
        return good(source, timeout_s)

    bench.source.script += [ask_and_hang, *[good] * 8]
    assert "busy for too long" in _refusal(bench.run())
    assert _is_off(bench)
    bench = armed_bench([*[good] * 6])

    def disarm_and_hang(source, timeout_s):
        bench.ask(Disarm(operator="bob"))()
        source.clock.advance_ns(1_001 * MS)
        return good(source, timeout_s)

    bench.source.script += [disarm_and_hang, *[good] * 2]
    bench.run()
    assert bench.answers[-1].result(timeout=0) is None


def test_a_command_its_asker_gave_up_is_not_carried_out_but_a_disarming_is():
    bench = Bench([good] * 3)

    def ask_and_give_up():
        assert bench.loop.submit(ARM).cancel()

    bench.source.script += [after(ask_and_give_up), *[good] * 8]
    assert _is_off(bench.run())
    bench = armed_bench([*[good] * 6])

    def disarm_and_give_up():
        assert bench.loop.submit(Disarm(operator="bob")).cancel()

    bench.source.script += [after(disarm_and_give_up), *[good] * 3]
    bench.run()
    assert bench.records()[-1].gate_state is GateState.DISARMED
