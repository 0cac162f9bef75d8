"""A missing camera faults until it is back, despite acknowledgements; nothing from before is used after its return."""

from engine.control.outputs import LoopStatus
from engine.core.commands import Acknowledge, Arm
from engine.core.errors import CommandRefusedError, SourceAwayError
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import armed_bench
from tests.support.control.loop_bench import after, good
from tests.support.gating.streams import MS

OPERATOR = "bob"


def away(source, timeout_s):
    source.clock.advance_ns(round(timeout_s * 1e9))
    raise SourceAwayError("unplugged")


def acting(bench, command):
    """Ask between two looks, and find the camera still away."""

    def step(source, timeout_s):
        bench.ask(command)()
        return away(source, timeout_s)

    return step


def set_zero(bench):
    bench.pipeline.has_reference = True


def test_the_line_is_off_and_the_gate_faults_at_the_first_look_that_misses_the_camera():
    bench = armed_bench([good] * 5 + [away] * 3).run()
    assert bench.path()[2:4] == ["beam_on:", "fault:source_lost"]
    assert [edge.is_on for edge in bench.beam.edges] == [True, False]
    assert bench.loop.status.run_state is LoopStatus.ENDED, "the session outlives its camera's absence"


def test_the_line_is_off_before_the_lease_of_the_last_frame_ends():
    bench = armed_bench([good] * 5 + [away] * 3)
    bench.run()
    last_ns = bench.records()[-1].received_ns
    assert bench.beam.edges[-1].at_ns - last_ns <= 80 * MS


def test_acknowledging_while_it_is_away_faults_again_at_once():
    bench = armed_bench([good] * 5)
    bench.source.script += [away, acting(bench, Acknowledge(operator=OPERATOR)), away, away]
    bench.run()
    faults = [one for one in bench.path() if one.startswith("fault")]
    assert set(faults) == {"fault:source_lost"}
    assert bench.loop.gate.state is not GateState.BEAM_ON
    assert bench.beam.edges[-1].is_on is False


def test_the_pipeline_is_notified_once_before_the_first_frame_after_the_return():
    bench = armed_bench([good] * 5 + [away] * 3 + [good] * 4 + [away, good])
    bench.run()
    assert bench.pipeline.calls == ["camera_returned", "camera_returned"]


def test_arming_is_refused_until_the_reference_is_set_again_and_the_dwell_is_full():
    bench = armed_bench([good] * 5 + [away] * 3 + [good] * 3)
    bench.source.script += [
        after(bench.ask(Acknowledge(operator=OPERATOR))),
        good,
        after(bench.ask(Arm(operator=OPERATOR))),
        good,
        after(lambda: set_zero(bench)),
        after(bench.ask(Arm(operator=OPERATOR))),
        *[good] * 6,
    ]
    bench.run()
    refused, armed = bench.answers[-2], bench.answers[-1]
    assert isinstance(refused.exception(timeout=0), CommandRefusedError)
    assert armed.result(timeout=0) is None
    assert bench.path()[3:] == [
        "fault:source_lost",
        "disarmed:disarmed",
        "hold:dwell",
        "dwell:dwell",
        "beam_on:",
        "disarmed:source_ended",
    ]


def test_the_fault_stays_when_frames_come_again_until_a_person_acknowledges():
    bench = armed_bench([good] * 5 + [away] + [good] * 20).run()
    after_return = bench.records()[-15:]
    assert {record.gate_state for record in after_return} == {GateState.FAULT}
    assert {record.hold_reason for record in after_return} == {HoldReason.SOURCE_LOST}


def test_the_page_gets_the_return_and_the_next_steps():
    bench = armed_bench([good] * 5)
    shown = []
    look = after(lambda: shown.append(bench.loop.status.view.detail))
    bench.source.script += [away, look, good, look, good, away, look]
    bench.run()
    back = "unplugged; it is back: acknowledge, set the reference, arm"
    assert shown == ["unplugged", back, "unplugged"]
