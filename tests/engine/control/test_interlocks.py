"""What stands against the beam in a running loop: part of every decision, for as long as it lasts, and no longer."""

from dataclasses import replace

import pytest

from engine.core.commands import Acknowledge, Arm, SetReference
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from engine.core.learning_status import LearningEvent, LearningEventKind
from engine.core.warmth import Warmth
from tests.support.control.armed_bench import ARM, LEARNED, ON, lying_at, on_bench
from tests.support.control.loop_bench import DEPTH, DESCRIPTION, Bench, after, good
from tests.support.gating.streams import A_BREATH_FRAMES, FRAMES_A_DWELL, LIMITS, MEASURING_NS, MS, PERIOD_NS, motion_of

DRIFT_MS = 0.2
"""How much the promptest frame may have aged meanwhile: the clocks are allowed to drift."""


def live(bench: Bench) -> Bench:
    """A camera instead of a recording."""
    bench.source.open = lambda: replace(DESCRIPTION, is_live=True)
    return bench


def frozen(source, timeout_s):
    return replace(good(source, timeout_s), depth_mm=DEPTH.copy())


def every(period_ms):
    def step(source, _timeout_s):
        source.clock.advance_ns(int(period_ms * MS) - MEASURING_NS)
        return source.frame()

    return step


def seen_of(records):
    return {(record.gate_state, record.hold_reason, record.line_on) for record in records}


def test_a_frozen_picture_holds_the_line_and_a_new_one_lets_it_on_after_the_dwell():
    records = on_bench([frozen, frozen, *[good] * 5]).run().records()
    assert records[ON].line_on
    assert seen_of(records[ON + 1 : ON + 3]) == {(GateState.HOLD, HoldReason.FRAME_FROZEN, False)}
    assert [record.line_on for record in records[ON + 3 :]] == [False] * (FRAMES_A_DWELL - 1) + [True] * 2


def test_a_picture_that_stays_frozen_faults_and_still_does_when_it_is_acknowledged():
    bench = on_bench([frozen] * 5)
    bench.source.script += [
        lambda source, timeout_s: (bench.ask(Acknowledge(operator="bob"))(), frozen(source, timeout_s))[1],
        frozen,
        frozen,
    ]
    records = bench.run().records()
    assert seen_of(records[ON + 3 :]) == {(GateState.FAULT, HoldReason.FRAME_STALE, False)}
    assert bench.answers[-1].exception(timeout=0) is None
    reported = [(change.to_state, change.reason) for change in bench.transitions()]
    assert reported.count((GateState.FAULT, HoldReason.FRAME_STALE)) == 1


def test_pictures_that_are_repeated_now_and_then_fault_before_they_can_be_100_ms_old():
    """Nothing in the pictures between them tells whether the camera caught up."""
    records = on_bench([*[frozen, *[good] * 30] * 3]).run().records()
    assert [record.line_on for record in records[ON + 29 : ON + 63 : 31]] == [True, True]
    assert seen_of(records[ON + 63 :]) == {(GateState.FAULT, HoldReason.FRAME_STALE, False)}


def test_a_camera_below_its_least_rate_holds_after_a_second_and_a_quicker_one_is_let_on_again():
    limits = replace(LIMITS, min_fps=20.0)
    records = on_bench([*[every(55.0)] * 40, *[good] * 40], limits=limits).run().records()
    slow = records[ON + 1 : ON + 41]
    assert slow[0].line_on
    assert slow[-1].hold_reason is HoldReason.FRAME_RATE_LOW
    for record in slow:
        recent = [one for one in records if 0 <= record.received_ns - one.received_ns < 1_000 * MS]
        has_second = record.received_ns - records[0].received_ns >= 1_000 * MS
        assert (record.hold_reason is HoldReason.FRAME_RATE_LOW) is (has_second and len(recent) < 20)
    assert records[-1].line_on


def test_nothing_is_stated_of_the_rate_before_there_was_a_second():
    limits = replace(LIMITS, min_fps=60.0)
    records = on_bench([good] * 40, limits=limits).run().records()
    start_ns = records[0].received_ns
    for record in records[ON:]:
        assert record.line_on is (record.received_ns - start_ns < 1_000 * MS)
    assert records[-1].hold_reason is HoldReason.FRAME_RATE_LOW


def test_a_patient_who_moves_holds_until_they_lie_there_again():
    bench = on_bench([good] * 12)
    lying_at(bench, ON + 3, 7.0)
    for index in range(ON + 6, 60):
        bench.pipeline.spoil[index] = bench.pipeline.spoil[0]
    records = bench.run().records()
    assert records[ON + 2].line_on
    assert seen_of(records[ON + 3 : ON + 6]) == {(GateState.HOLD, HoldReason.PATIENT_SHIFTED, False)}
    assert [record.line_on for record in records[ON + 6 :]] == [False] * (FRAMES_A_DWELL - 1) + [True] * 4


def test_the_view_shows_how_far_the_patient_has_moved():
    bench = on_bench([good] * 2)
    lying_at(bench, ON + 1, 5.0)
    bench.run()
    assert bench.loop.status.view.movement.shift_mm == pytest.approx(5.0)
    bench = on_bench([good] * 2)
    lying_at(bench, 0, 5.0)
    bench.pipeline.has_reference = False
    bench.run()
    assert bench.loop.status.view.movement is None


def test_a_model_that_carries_the_reference_does_not_hide_that_the_patient_moved():
    bench = on_bench([])

    def swap():
        bench.pipeline.model, bench.pipeline.model_generation = object(), 2

    lying_at(bench, ON + 2, 7.0)
    bench.source.script += [after(swap), good, after(bench.ask(ARM)), *[good] * 6]
    last = bench.run().records()[-1]
    assert (last.gate_state, last.hold_reason) == (GateState.HOLD, HoldReason.PATIENT_SHIFTED)


def test_a_reference_set_by_a_person_takes_the_patient_as_they_lie():
    bench = on_bench([])
    lying_at(bench, ON + 2, 7.0)
    bench.source.script += [
        *[good] * 3,
        after(bench.ask(SetReference(operator="bob"))),
        after(bench.ask(ARM)),
        *[good] * 6,
    ]
    assert bench.run().records()[-1].line_on


def test_a_model_too_old_holds_until_another_takes_over_or_it_is_found_alike():
    bench = on_bench([], limits=replace(LIMITS, max_model_age_min=1.0))

    def found_alike():
        notice = LearningEvent(
            kind=LearningEventKind.COMPARED, detail="alike", timestamp_us=0, figures={"is_accepted": True}
        )
        bench.pipeline.notices.append(notice)

    for index in (start + frame for start in range(400, 1800, 400) for frame in range(A_BREATH_FRAMES)):
        bench.pipeline.spoil[index] = lambda frame: replace(frame, motion=motion_of(3.3))
    bench.source.script += [*[good] * 1800, after(found_alike), *[good] * 5]
    records = bench.run().records()
    first_ns = records[0].received_ns
    for record in records[ON:-6]:
        if record.hold_reason not in {HoldReason.OUTSIDE_WINDOW, HoldReason.DWELL}:
            assert record.line_on is (record.received_ns - first_ns <= 60_000 * MS)
    assert sum(record.line_on for record in records) > 1650
    assert records[-7].hold_reason is HoldReason.MODEL_OLD
    assert [record.line_on for record in records[-6:]] == [False] * (FRAMES_A_DWELL - 1) + [True] * 3


def test_a_camera_that_was_never_calibrated_is_armed_but_never_permitted():
    bench = on_bench([good] * 20, limits=replace(LIMITS, is_calibrated=False))
    records = bench.run().records()
    assert bench.beam.permits == []
    assert seen_of(records[LEARNED + 1 :]) == {(GateState.HOLD, HoldReason.CALIBRATION_MISSING, False)}


def test_a_reference_that_was_set_cold_is_dropped_when_the_camera_is_warm():
    """Armed with it cold, there is no beam; warm, the reference has to be set again, and from then on it permits."""
    limits = replace(LIMITS, warm_up_s=600.0, cold_share=0.101)  # 2.6 s are left
    set_it, arm = (
        SetReference(operator="ann", reason="as the test wants it"),
        Arm(operator="ann", head_direction=LIMITS.head_direction),
    )
    bench = Bench([good] * 3, limits=limits)
    bench.source.script += [after(bench.ask(set_it)), *[good] * 3, after(bench.ask(arm)), *[good] * 120]

    def set_again():
        bench.pipeline.has_reference = True
        bench.ask(set_it)()

    bench.source.script += [after(set_again), good, after(bench.ask(arm)), *[good] * 20]
    records = bench.run().records()
    assert [answer.exception(timeout=0) for answer in bench.answers] == [None] * 4
    left_s, first_ns = Warmth(600.0, 0.101).left_s, records[0].received_ns
    cold = [record for record in records if record.received_ns - first_ns < left_s * 1e9]
    assert not any(record.line_on for record in records[:-20])
    assert cold[-1].hold_reason is HoldReason.CAMERA_WARMING
    assert records[len(cold) + 1].hold_reason is HoldReason.DISARMED
    assert bench.pipeline.calls.count("camera_warmed") == 1
    assert records[-1].line_on


def test_a_camera_that_was_warm_when_the_reference_was_set_keeps_it():
    bench = on_bench([good] * 120, limits=replace(LIMITS, warm_up_s=600.0, cold_share=0.05))
    assert bench.run().records()[-1].line_on
    assert "camera_warmed" not in bench.pipeline.calls


def test_a_command_that_is_sent_too_late_faults_and_the_line_is_held_at_once():
    bench = live(on_bench([good] * 5, limits=replace(LIMITS, max_latency_ms=100.0, max_frame_age_ms=90.0)))
    slow = ON + 2

    def dawdle(lease):
        if lease.sequence == slow - (LEARNED + FRAMES_A_DWELL) + 1:
            bench.clock.advance_ns(40 * MS)  # within both leases, and past the latency with the camera's own

    bench.beam.before_permit = dawdle
    limits = bench.loop._limits
    limits.current = replace(limits.current, camera_latency_ms=70.0)
    records = bench.run().records()
    assert records[slow - 1].line_on
    assert seen_of(records[slow:]) == {(GateState.FAULT, HoldReason.LATENCY_HIGH, False)}
    fault = next(change for change in bench.transitions() if change.reason is HoldReason.LATENCY_HIGH)
    assert fault.detail == "115 ms since the camera took the frame, 100 allowed"
    assert bench.hold_reason_of_the_line() is HoldReason.LATENCY_HIGH


def test_a_line_whose_lease_lapsed_between_two_good_frames_pays_a_full_dwell():
    """A frame 59 ms after the last, measured in 25: each is allowed, and the lease of 80 ms is over."""
    bench = on_bench([every(59.0), *[good] * 6])

    def dawdle(frame):
        bench.clock.advance_ns(20 * MS)
        return frame

    bench.pipeline.spoil[ON + 1] = dawdle
    records = bench.run().records()
    assert records[ON].line_on
    assert (records[ON + 1].hold_reason, records[ON + 1].line_on) == (HoldReason.FRAME_LATE, False)
    assert [record.line_on for record in records[ON + 2 :]] == [False] * (FRAMES_A_DWELL - 1) + [True] * 3
    assert bench.beam.edges[1].reason is None  # it had lapsed by itself


def test_latency_is_measured_from_capture_and_warned_of_without_a_hold():
    bench = live(on_bench([good] * 5, limits=replace(LIMITS, warn_latency_ms=40.0, camera_latency_ms=30.0)))
    views = []
    late = ON + 2

    def lagging(source, _timeout_s):
        source.clock.advance_ns(PERIOD_NS - MEASURING_NS + 6 * MS)
        frame = source.frame()
        return replace(frame, timestamp_us=frame.timestamp_us - 6_000)

    bench.source.script[ON + 2] = lagging
    bench.source.script[ON + 3] = after(lambda: views.append(bench.loop.status.view))
    records = bench.run().records()
    taken_ms = [record.latency_ms for record in records[ON:]]
    assert taken_ms == pytest.approx([35.0, 35.0, 41.0, 35.0, 35.0, 35.0], abs=DRIFT_MS)
    assert all(record.line_on for record in records[ON:])
    assert views[0].latency.last_ms == pytest.approx(41.0, abs=DRIFT_MS)
    assert views[0].latency.is_warned
    assert views[0].record.measurement.frame_index == late
    last = bench.loop.status.view.latency
    assert (last.last_ms, last.max_ms) == pytest.approx((35.0, 41.0), abs=DRIFT_MS)
    assert not last.is_warned


def test_every_transition_of_a_frame_carries_its_latency_and_one_of_a_person_has_none():
    bench = on_bench([]).run()
    armed, dwell, on, _end = bench.transitions()
    assert (armed.captured_ns, armed.latency_ms) == (None, None)
    for change in (dwell, on):
        assert change.latency_ms == MEASURING_NS / MS
        assert change.captured_ns == change.received_ns


@pytest.mark.parametrize(
    "reason", [HoldReason.BEAM_LINE_FAILED, HoldReason.BEAM_LINE_MISMATCH, HoldReason.BEAM_WITHOUT_PERMIT]
)
def test_what_a_line_finds_by_itself_between_two_frames_faults_at_the_next_decision_and_is_named(reason):
    bench = on_bench([])
    bench.source.script += [after(lambda: bench.beam.on_trouble(reason, "the line itself saw it")), *[good] * 3]
    records = bench.run().records()
    assert seen_of(records[ON + 1 :]) == {(GateState.FAULT, reason, False)}
    fault = next(change for change in bench.transitions() if change.to_state is GateState.FAULT)
    assert fault.detail == "the line itself saw it"


def test_a_device_clock_that_jumps_ahead_faults_a_live_camera():
    def jump(source, timeout_s):
        frame = good(source, timeout_s)
        return replace(frame, timestamp_us=frame.timestamp_us + 300_000, color_timestamp_us=frame.timestamp_us)

    record = live(on_bench([jump])).run().records()[-1]
    assert (record.gate_state, record.hold_reason, record.line_on) == (
        GateState.FAULT,
        HoldReason.CLOCK_JUMPED,
        False,
    )


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"is_calibrated": False}, HoldReason.CALIBRATION_MISSING),
        ({"warm_up_s": 900.0}, HoldReason.CAMERA_WARMING),
        ({"max_model_age_min": 1.0}, HoldReason.MODEL_OLD),
    ],
    ids=str,
)
def test_an_arming_shows_at_once_what_stands_against_the_beam(limits, reason):
    bench = Bench([good] * 3, limits=replace(LIMITS, **limits))
    seen = []
    bench.source.script += [
        *[good] * 1800,
        after(lambda: bench.loop.submit(ARM).add_done_callback(lambda _: seen.append(bench.loop.gate.reason))),
        good,
    ]
    bench.run()
    assert seen == [reason]


def test_the_gate_is_not_armed_onto_a_frozen_picture():
    """Its values are those of another moment; pictures are compared while the gate is disarmed, too."""
    bench = Bench([good] * 3)
    bench.source.script += [
        frozen,
        lambda source, timeout_s: (bench.ask(Arm(operator="ann"))(), frozen(source, timeout_s))[1],
        *[good] * 3,
    ]
    records = bench.run().records()
    assert isinstance(bench.answers[-1].exception(timeout=0), CommandRefusedError)
    assert {(record.gate_state, record.line_on) for record in records} == {(GateState.DISARMED, False)}
