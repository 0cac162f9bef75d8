"""The loop from frame to line: what it permits, when it holds, and what it tells."""

from dataclasses import replace

import pytest

from engine.control.outputs import LoopStatus
from engine.core.clock import NS_PER_MS
from engine.core.commands import Acknowledge, Arm
from engine.core.frames import MeasurementState
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import LEARNED, ON_AT, armed_bench
from tests.support.control.loop_bench import COLOR, DESCRIPTION, Bench, after, good, silent
from tests.support.gating.bad_frames import FAULTS, HOLDS
from tests.support.gating.streams import LEVEL_MM, LIMITS, MEASURING_NS, MS, PERIOD_NS, unmeasured


def test_good_frames_in_an_armed_session_turn_the_beam_on_after_the_dwell():
    bench = armed_bench([good] * 8).run()
    records = bench.records()
    assert bench.answers[0].result(timeout=0) is None
    assert [record.gate_state for record in records[LEARNED + 1 :]] == [GateState.DWELL] * 3 + [GateState.BEAM_ON] * 5
    assert [record.line_on for record in records] == [index >= ON_AT for index in range(12)]
    assert [record.hold_reason is None for record in records] == [index >= ON_AT for index in range(12)]
    assert bench.path() == ["hold:dwell", "dwell:dwell", "beam_on:", "disarmed:source_ended"]


def test_the_line_gets_one_lease_a_frame_counted_from_when_the_frame_came():
    bench = armed_bench([good] * 8).run()
    received = [record.received_ns for record in bench.records()][ON_AT:]
    assert [lease.expires_ns for lease in bench.beam.permits] == [at_ns + 80 * MS for at_ns in received]
    assert [lease.sequence for lease in bench.beam.permits] == [1, 2, 3, 4, 5]
    assert [edge.is_on for edge in bench.beam.edges] == [True, False]


def test_a_frame_is_learned_from_once_the_line_has_its_lease():
    bench = armed_bench([good] * 8)
    seen = []
    bench.pipeline.after_decision = lambda: seen.append((bench.loop.gate.last.index, len(bench.beam.permits)))
    bench.run()
    assert seen == [(index, max(0, index - ON_AT + 1)) for index in range(12)]


def test_without_arming_nothing_is_permitted():
    bench = Bench([good] * 30).run()
    assert bench.beam.permits == []
    assert {record.gate_state for record in bench.records()} == {GateState.DISARMED}


@pytest.mark.parametrize(("spoil", "reason"), {**HOLDS, **FAULTS}.values(), ids={**HOLDS, **FAULTS})
def test_the_line_is_off_at_the_first_bad_frame(spoil, reason):
    bench = armed_bench([good] * 8)
    bad_index = ON_AT + 2
    bench.pipeline.spoil[bad_index] = spoil
    bench.run()
    record = bench.records()[bad_index]
    assert not record.line_on
    assert record.gate_state is (GateState.FAULT if reason.is_fault else GateState.HOLD) or (
        record.hold_reason is HoldReason.VALUE_INVALID  # the loop itself sees a measurement that is not its frame's
    )
    assert bench.beam.edges[1].at_ns == record.decided_ns


def test_a_missing_frame_holds_within_one_period_of_when_it_was_due():
    bench = armed_bench([*[good] * 5, silent, *[good] * 6]).run()
    last_on = bench.records()[LEARNED + 1 + 4]
    assert last_on.line_on
    off = bench.beam.edges[1]
    assert off.reason is HoldReason.FRAME_MISSING
    assert off.at_ns - (last_on.received_ns + PERIOD_NS) <= PERIOD_NS
    assert off.at_ns == last_on.received_ns + 60 * MS  # counted from the last frame, not from when it was decided on


def test_after_a_silence_the_dwell_is_full():
    bench = armed_bench([*[good] * 5, silent, *[good] * 6]).run()
    states = [record.gate_state for record in bench.records()[LEARNED + 6 :]]
    # The frame after the silence comes late: a gap. The dwell begins with the one behind it.
    assert states == [GateState.HOLD, *[GateState.DWELL] * 3, *[GateState.BEAM_ON] * 2]


def test_a_long_silence_faults_and_nothing_but_a_person_clears_it():
    bench = armed_bench([*[good] * 5, *[silent] * 9, *[good] * 10]).run()
    assert "fault:frame_timeout" in bench.path()
    assert {record.gate_state for record in bench.records()[-10:]} == {GateState.FAULT}
    assert len(bench.beam.edges) == 2


def test_a_source_that_never_shows_anything_is_lost_after_a_while():
    bench = Bench([silent] * 400).run()
    assert (bench.loop.status.run_state, bench.loop.gate.reason) == (LoopStatus.FAILED, HoldReason.SOURCE_LOST)
    assert "nothing for 10 s" in bench.loop.status.error


def test_silence_is_shown_on_the_newest_view():
    bench = armed_bench([*[good] * 5])
    seen = []
    bench.source.script += [silent, after(lambda: seen.append(bench.loop.status.view))]
    bench.run()
    assert seen[0].record.hold_reason is HoldReason.FRAME_MISSING
    assert not seen[0].record.line_on
    assert seen[0].frames == LEARNED + 6


def test_every_decision_carries_its_times_in_order():
    bench = armed_bench([good] * 8).run()
    for record in bench.records():
        assert record.decided_ns - record.received_ns == MEASURING_NS
        assert record.received_ns < record.decided_ns <= record.asserted_ns
    on = next(change for change in bench.transitions() if change.to_state is GateState.BEAM_ON)
    assert (on.frame_index, on.from_state, on.reason, on.operator) == (ON_AT, GateState.DWELL, None, None)
    assert on.captured_us * 1_000 == on.received_ns < on.decided_ns <= on.asserted_ns


def test_a_transition_a_person_caused_names_the_person():
    bench = armed_bench([good]).run()
    armed = bench.transitions()[0]
    assert (armed.operator, armed.frame_index, armed.to_state) == ("ann", None, GateState.HOLD)


def test_the_view_shows_the_newest_frame_and_its_figures():
    bench = armed_bench([good] * 40)
    bench.pipeline.spoil[20] = lambda frame: unmeasured(frame, MeasurementState.TRAINING)
    bench.run()
    view = bench.loop.status.view
    assert view.record.measurement.frame_index == 43
    assert view.color is not None
    assert view.color.shape == COLOR.shape
    assert (view.frames, view.missed_frames, view.dropped_records) == (44, 0, 0)
    assert view.fps == pytest.approx(29.97, abs=0.01)
    assert view.latency.last_ms == view.latency.p50_ms == view.latency.p99_ms == MEASURING_NS / NS_PER_MS
    assert (view.is_armed, view.description, view.status) == (False, DESCRIPTION, LoopStatus.ENDED)
    assert view.record.signal_mm == LEVEL_MM


def test_a_frame_that_was_not_measured_has_no_signal_rather_than_zero():
    bench = Bench([good] * 3)
    bench.pipeline.spoil[1] = lambda frame: unmeasured(frame, MeasurementState.TRAINING)
    assert [record.signal_mm for record in bench.run().records()] == [LEVEL_MM, None, LEVEL_MM]


def test_frames_the_device_lost_are_counted_and_hold():
    bench = armed_bench([*[good] * 5])

    def with_loss(source, _timeout_s):
        source.clock.advance_ns(PERIOD_NS - MEASURING_NS)
        return source.frame(missed_frames=2)

    bench.source.script.append(with_loss)
    bench.run()
    assert bench.loop.status.view.missed_frames == 2
    assert bench.records()[-1].hold_reason is HoldReason.FRAME_MISSING


@pytest.mark.parametrize(
    "change",
    [{"frame_index": 99}, {"timestamp_us": 5_000_001}, {"received_ns": 5_000_000_001}, {"missed_frames": 1}],
    ids=str,
)
def test_a_measurement_of_another_frame_faults(change):
    bench = armed_bench([good] * 8)
    bench.pipeline.spoil[ON_AT + 1] = lambda frame: replace(frame, **change)
    bench.run()
    record = bench.records()[ON_AT + 1]
    assert (record.gate_state, record.hold_reason, record.line_on) == (
        GateState.FAULT,
        HoldReason.VALUE_INVALID,
        False,
    )


@pytest.mark.parametrize(
    ("missing", "reason"), [("model", HoldReason.MODEL_MISSING), ("reference", HoldReason.REFERENCE_MISSING)]
)
def test_losing_the_model_or_the_reference_holds_even_where_nothing_stated_so(missing, reason):
    bench = armed_bench([*[good] * 6])

    def lose():
        if missing == "model":
            bench.pipeline.model = None
        else:
            bench.pipeline.has_reference = False

    bench.source.script += [after(lose), *[good] * 6]
    records = bench.run().records()
    assert records[LEARNED + 6].line_on
    assert {(record.hold_reason, record.line_on) for record in records[LEARNED + 7 :]} == {(reason, False)}


def test_a_model_swapped_between_two_frames_disarms():
    bench = armed_bench([*[good] * 6])

    def swap():
        bench.pipeline.model_generation += 1

    bench.source.script += [after(swap), *[good] * 8]
    records = bench.run().records()
    assert records[LEARNED + 6].line_on
    assert {(record.gate_state, record.line_on) for record in records[LEARNED + 7 :]} == {(GateState.DISARMED, False)}


def test_a_fault_of_somebody_else_is_part_of_the_next_decision_and_latches():
    bench = armed_bench([*[good] * 6])
    tell = bench.loop.report_fault
    bench.source.script += [after(lambda: tell(HoldReason.DISK_LOW, "20 MB left")), *[good] * 5]
    bench.run()
    first, *later = bench.records()[LEARNED + 7 :]
    assert (first.gate_state, first.hold_reason, first.line_on) == (GateState.FAULT, HoldReason.DISK_LOW, False)
    assert {record.gate_state for record in later} == {GateState.FAULT}


def test_of_faults_that_come_together_the_first_reported_is_named_as_the_cause():
    bench = armed_bench([*[good] * 6])
    spoil, _reason = FAULTS["whole is NaN"]
    bench.pipeline.spoil[LEARNED + 7] = spoil

    def report_twice():
        bench.loop.report_fault(HoldReason.DISK_LOW, "20 MB left")
        bench.loop.report_fault(HoldReason.UNKNOWN, "and something else")

    bench.source.script += [after(report_twice), good]
    bench.run()
    fault = next(change for change in bench.transitions() if change.to_state is GateState.FAULT)
    assert (fault.reason, fault.detail) == (HoldReason.DISK_LOW, "20 MB left")


def test_only_a_fault_can_be_reported():
    with pytest.raises(ValueError, match="no fault"):
        Bench([]).loop.report_fault(HoldReason.JUMP, "")


def test_a_stage_that_takes_too_long_makes_its_own_estimate_late():
    bench = armed_bench([good] * 8)

    def dawdle(frame):
        bench.clock.advance_ns(60 * MS)
        return frame

    bench.pipeline.spoil[ON_AT + 1] = dawdle
    bench.run()
    record = bench.records()[ON_AT + 1]
    assert (record.hold_reason, record.line_on) == (HoldReason.FRAME_LATE, False)


@pytest.mark.parametrize("is_live", [True, False])
def test_a_backlog_holds_a_live_camera_and_not_a_recording_whose_player_fell_behind(is_live):
    bench = armed_bench([])
    bench.source.open = lambda: replace(DESCRIPTION, is_live=is_live)

    def ever_later(source, _timeout_s):
        source.clock.advance_ns(PERIOD_NS - MEASURING_NS)
        frame = source.frame()
        return replace(frame, timestamp_us=frame.timestamp_us - 8_000 * frame.index)

    bench.source.script += [ever_later] * 20
    last = bench.run().records()[-1]
    assert (last.hold_reason is HoldReason.FRAME_LATE) is is_live
    assert last.line_on is not is_live


def test_a_fault_acknowledged_and_armed_again_leads_to_beam_on_again():
    bench = armed_bench([*[good] * 6])
    tell = bench.loop.report_fault
    bench.source.script += [
        after(lambda: tell(HoldReason.DISK_LOW, "")),
        after(bench.ask(Acknowledge(operator="bob"))),
        good,
        after(bench.ask(Arm(operator="bob"))),
        *[good] * 6,
    ]
    bench.run()
    assert [answer.exception(timeout=0) for answer in bench.answers] == [None] * 3
    assert bench.path()[2:] == [
        "beam_on:",
        "fault:disk_low",
        "disarmed:disarmed",
        "hold:dwell",
        "dwell:dwell",
        "beam_on:",
        "disarmed:source_ended",
    ]
    assert LIMITS.dwell_ms > 0
