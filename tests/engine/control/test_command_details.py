"""What the gate says after a command, and whom the record names: the words and names that a person reads."""

import math
from dataclasses import replace

import pytest

from engine.control.outputs import FrameRecord, GateTransition
from engine.control.session_state import SessionLimits
from engine.core.commands import ActivateModel, ApplyModel, CorrectBaseline, HoldBeam, SetReference
from engine.core.errors import FrameTimeoutError
from engine.core.gate_state import GateState, HoldReason
from engine.gating.active_window import SetWindow
from engine.gating.interlocks import WATCHDOG_DETAIL
from engine.gating.windows import AmplitudeWindow
from tests.support.control.armed_bench import ARM, armed_bench, on_bench
from tests.support.control.loop_bench import DESCRIPTION, Bench, after, good
from tests.support.gating.streams import LEVEL_MM, LIMITS, MS, measured, motion_of


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


def test_the_gate_states_which_window_was_set():
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


def test_a_permit_that_the_watchdog_s_hold_refuses_states_it():
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


def test_a_fault_at_a_frame_is_recorded_without_who_holds_by_hand():
    bench = on_bench([])
    bench.source.script += [
        after(bench.ask(HoldBeam(operator="cid"))),
        good,
        after(lambda: bench.loop.report_fault(HoldReason.DISK_LOW, "10 MB left")),
        good,
    ]
    bench.run()
    transitions = bench.transitions()
    held = next(one for one in transitions if one.reason is HoldReason.OPERATOR_HOLD)
    fault = next(one for one in transitions if one.reason is HoldReason.DISK_LOW)
    assert (held.operator, fault.operator) == ("cid", None)


class Noting:
    """A tap that keeps what the engine emits."""

    def __init__(self):
        self.emitted = []

    def observe(self, _kind, read):
        return read()

    def emit(self, outcome):
        self.emitted.append(outcome)

    def begin(self):
        """Do nothing."""

    turn = end = begin


def test_every_sample_and_transition_is_emitted_as_it_is_recorded():
    tap = Noting()
    bench = armed_bench([good] * 6, tap=tap).run()
    emitted = {kind: [one for one in tap.emitted if type(one) is kind] for kind in (FrameRecord, GateTransition)}
    assert emitted[FrameRecord] == bench.records() != []
    assert [replace(one, number=None) for one in emitted[GateTransition]] == [
        replace(one, number=None) for one in bench.transitions()
    ]
    assert len(tap.emitted) == len(emitted[FrameRecord]) + len(emitted[GateTransition])


def test_a_permit_that_goes_on_and_came_too_late_is_no_change_before_its_fault():
    bench = armed_bench([good] * 6, limits=replace(LIMITS, max_latency_ms=100.0, camera_latency_ms=60.0))
    bench.beam.before_permit = lambda lease: bench.clock.advance_ns(40 * MS if lease.sequence == 3 else 0)
    assert bench.run().path()[:4] == ["hold:dwell", "dwell:dwell", "beam_on:", "fault:latency_high"]


@pytest.mark.parametrize(("max_latency_ms", "is_fault"), [(105.0, False), (104.9, True)])
def test_a_latency_that_equals_its_bound_is_no_fault(max_latency_ms, is_fault):
    """60 ms in the camera, 5 to measure, and 40 until the line is ordered."""
    bench = armed_bench([good] * 6, limits=replace(LIMITS, max_latency_ms=max_latency_ms, camera_latency_ms=60.0))
    bench.beam.before_permit = lambda lease: bench.clock.advance_ns(40 * MS if lease.sequence == 3 else 0)
    assert ("fault:latency_high" in bench.run().path()) is is_fault


@pytest.mark.parametrize("late_ns", [0, 1])
def test_arming_needs_a_frame_not_older_than_its_bound_itself(late_ns):
    bench = Bench([good] * 3)
    longest_ns = int((LIMITS.max_gap_ms + LIMITS.max_frame_age_ms) * MS)

    def ask_at_the_bound(source, _timeout_s):
        bench.ask(ARM)()
        source.clock.advance_ns(bench.loop.gate.last.received_ns + longest_ns + late_ns - source.clock.now_ns())
        raise FrameTimeoutError("nothing came")

    bench.source.script += [ask_at_the_bound, good]
    error = bench.run().answers[0].exception(timeout=0)
    assert (error is None) is (late_ns == 0)
    assert error is None or "ms old" in str(error)


def test_a_signal_that_is_no_number_is_recorded_as_none():
    limits = SessionLimits(LIMITS)
    assert limits.signal_mm(measured(0, motion_of(math.nan))) is None
    assert limits.signal_mm(measured(0, motion_of(1.5))) == 1.5


def test_the_status_shows_the_source_the_learning_and_the_learned_range():
    status = armed_bench([good] * 6).run().loop.status
    assert status.source == DESCRIPTION
    assert (status.learning.model_generation, status.learning.reference_number) == (1, 1)
    (learned,) = status.learned_ranges.values()
    assert (learned.low, learned.high) == pytest.approx((LEVEL_MM, LEVEL_MM + 10.0), abs=1.0)
