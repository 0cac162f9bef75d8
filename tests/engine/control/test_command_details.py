"""What the gate says after a command, and whom the record names: the words and names that a person reads."""

import pytest

from engine.core.commands import ActivateModel, ApplyModel, CorrectBaseline, HoldBeam, SetReference
from engine.core.gate_state import GateState, HoldReason
from engine.gating.interlocks import WATCHDOG_DETAIL
from engine.gating.window_change import SetWindow
from engine.gating.windows import AmplitudeWindow
from tests.support.control.armed_bench import armed_bench, on_bench
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import MS


@pytest.mark.parametrize(
    ("command", "detail"),
    [
        (ActivateModel(operator="bob", model=object()), "another model is activated"),
        (ApplyModel(operator="bob"), "a new model is applied"),
        (SetReference(operator="bob"), "the reference is set"),
        (
            CorrectBaseline(operator="bob", by=0.5),
            "the baseline is corrected by 0.5: the window was whole -1 to 3 mm and is whole -0.5 to 3.5 mm",
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_disarmed_the_gate_is_displayed_and_recorded(command, detail):
    bench = on_bench([])
    bench.pipeline.is_model_waiting = True
    displayed = []
    bench.source.script += [
        after(bench.ask(command)),
        after(lambda: displayed.append(bench.loop.status.view.detail)),
    ]
    bench.run()
    assert bench.answers[-1].exception(timeout=0) is None
    change = next(one for one in bench.transitions() if one.reason is HoldReason.DISARMED)
    assert (change.detail, change.operator, displayed) == (detail, "bob", [detail])


def test_the_gate_says_which_window_was_set():
    bench = Bench([good] * 3)
    window = AmplitudeWindow(lower=0.0, upper=4.0)
    command = SetWindow(
        operator="bob", window=window, dwell_ms=100.0, min_on_ms=0.0, min_off_ms=0.0, max_cycles_per_min=120
    )
    displayed = []
    bench.source.script += [
        after(bench.ask(command)),
        after(lambda: displayed.append(bench.loop.status.view.detail)),
    ]
    bench.run()
    assert bench.answers[-1].exception(timeout=0) is None
    assert displayed == ["the window was whole -1 to 3 mm and is whole 0 to 4 mm"]


def test_a_fault_found_while_a_hold_by_hand_is_carried_out_is_recorded_with_who_held():
    bench = on_bench([])

    def fault_and_hold(_lease):
        bench.beam.before_permit = lambda _lease: None
        bench.loop.report_fault(HoldReason.DISK_LOW, "10 MB left")
        bench.ask(HoldBeam(operator="cid"))()

    bench.source.script += [after(lambda: setattr(bench.beam, "before_permit", fault_and_hold)), good]
    bench.run()
    fault = next(one for one in bench.transitions() if one.to_state is GateState.FAULT)
    assert (fault.reason, fault.operator) == (HoldReason.DISK_LOW, "cid")


def test_a_permit_that_the_watchdog_s_hold_refuses_says_so():
    bench = on_bench([])

    def fire(_lease):
        bench.beam.before_permit = lambda _lease: None
        bench.watchdog.check(bench.clock.now_ns() + 10_000 * MS)

    bench.source.script += [after(lambda: setattr(bench.beam, "before_permit", fire)), good]
    displayed = []
    bench.source.script += [after(lambda: displayed.append(bench.loop.status.view))]
    bench.run()
    (view,) = displayed
    assert (view.record.gate_state, view.record.hold_reason) == (GateState.FAULT, HoldReason.WATCHDOG)
    assert view.detail == WATCHDOG_DETAIL


def test_the_watchdog_s_record_names_who_had_armed_and_is_made_once():
    bench = armed_bench([good] * 6)
    bench.source.script += [after(lambda: bench.watchdog.check(bench.clock.now_ns() + 10_000 * MS)), good]
    bench.run()
    bench.watchdog.on_fired(bench.clock.now_ns())
    faults = [one for one in bench.transitions() if one.reason is HoldReason.WATCHDOG]
    assert [(one.to_state, one.armed_by, one.detail) for one in faults] == [(GateState.FAULT, "ann", WATCHDOG_DETAIL)]
