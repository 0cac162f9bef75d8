"""Every way out of the engine holds the beam first; then it is closed and reported."""

import threading

import pytest

from engine.control.outputs import LoopStatus
from engine.core.commands import Arm, Disarm, SetReference
from engine.core.errors import (
    BeamLineError,
    CommandRefusedError,
    FrameTimeoutError,
    RecordingError,
    RuntimeMissingError,
    SourceLostError,
)
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import armed_bench
from tests.support.control.loop_bench import Bench, WatchedBeamLine, after, good, raising

FAILURES = {
    "camera lost": (SourceLostError("unplugged"), HoldReason.SOURCE_LOST, "unplugged"),
    "recording damaged": (RecordingError("cut after 12 frames"), HoldReason.SOURCE_LOST, "cut after 12 frames"),
    "a bug": (KeyError("depth"), HoldReason.ENGINE_FAILED, "KeyError: 'depth'"),
    "no memory": (MemoryError(), HoldReason.ENGINE_FAILED, "MemoryError: MemoryError"),
    "another known error": (
        RuntimeMissingError("no runtime"),
        HoldReason.ENGINE_FAILED,
        "RuntimeMissingError: no runtime",
    ),
}


def _is_held_and_reported(bench: Bench, reason: HoldReason, error: str) -> None:
    assert bench.beam.edges[-1].is_on is False
    assert bench.source.line_was_on_at_close is False
    assert (bench.loop.status.run_state, bench.loop.status.error) == (LoopStatus.FAILED, error)
    assert (bench.loop.gate.state, bench.loop.gate.reason) == (GateState.FAULT, reason)
    assert bench.loop.status.view.status is LoopStatus.FAILED
    assert bench.loop.status.view.error == error
    assert bench.loop.status.view.record.line_on is False
    assert bench.path()[-1] == f"fault:{reason}"


@pytest.mark.parametrize(("error", "reason", "text"), FAILURES.values(), ids=FAILURES)
def test_a_source_that_raises_ends_in_a_held_line_and_a_failed_session(error, reason, text):
    bench = armed_bench([*[good] * 6, raising(error)]).run()
    _is_held_and_reported(bench, reason, text)
    assert bench.hold_reason_of_the_line() is reason


@pytest.mark.parametrize(("error", "reason", "text"), FAILURES.values(), ids=FAILURES)
def test_a_pipeline_that_raises_ends_in_a_held_line_and_a_failed_session(error, reason, text):
    bench = armed_bench([good] * 12)

    def fail(_frame):
        raise error

    bench.pipeline.spoil[9] = fail
    bench.run()
    _is_held_and_reported(bench, reason, text)


def test_the_end_of_a_recording_holds_and_is_no_failure():
    bench = armed_bench([good] * 8).run()
    assert bench.hold_reason_of_the_line() is HoldReason.SOURCE_ENDED
    assert (bench.loop.status.run_state, bench.loop.status.error) == (LoopStatus.ENDED, None)
    assert bench.source.line_was_on_at_close is False
    assert bench.source.closed == 1


def test_stopping_holds_and_is_no_failure():
    bench = armed_bench([good] * 8)
    bench.source.script.append(after(bench.loop._stop_requested.set))
    bench.source.script += [good] * 50
    bench.run()
    assert bench.loop.status.run_state is LoopStatus.ENDED
    assert bench.hold_reason_of_the_line() is HoldReason.ENGINE_STOPPED
    assert bench.path()[-1] == "disarmed:engine_stopped"
    assert bench.loop.stop(timeout_s=5.0) is True


def test_a_source_that_cannot_be_opened_is_reported_with_its_own_words():
    bench = Bench([good])

    def refuse():
        raise RecordingError("not a recording: a picture")

    bench.source.open = refuse
    bench.run()
    assert (bench.loop.status.run_state, bench.loop.status.error) == (LoopStatus.FAILED, "not a recording: a picture")
    assert bench.loop.status.view is None
    assert bench.source.closed == 1


def test_a_line_that_cannot_be_opened_is_a_failed_session_without_a_camera():
    class Unplugged(WatchedBeamLine):
        def open(self):
            raise BeamLineError("no answer")

    bench = Bench([good], beam=Unplugged).run()
    assert (bench.loop.status.run_state, bench.loop.gate.reason) == (LoopStatus.FAILED, HoldReason.BEAM_LINE_FAILED)
    assert bench.source.opened == 0


def test_a_source_that_cannot_even_be_closed_changes_nothing():
    bench = armed_bench([good] * 8)

    def fail():
        raise OSError("stuck")

    bench.source.close = fail
    bench.run()
    assert bench.loop.status.run_state is LoopStatus.ENDED
    assert bench.beam.edges[-1].is_on is False


def test_a_line_whose_hold_raises_does_not_keep_the_session_from_ending():
    class Broken(WatchedBeamLine):
        is_broken = False

        def hold(self, reason):
            if self.is_broken:
                raise OSError("wire cut")
            super().hold(reason)

    bench = armed_bench([*[good] * 6], beam=Broken)

    def break_it():
        bench.beam.is_broken = True

    bench.source.script += [after(break_it), raising(SourceLostError("gone"))]
    bench.run()
    assert bench.loop.status.run_state is LoopStatus.FAILED
    assert bench.source.closed == 1
    bench.clock.advance_ns(100_000_000)
    assert bench.beam.edges[-1].is_on is False  # no one renews: the lease has lapsed


def test_what_still_waits_is_refused_at_the_end_and_a_disarming_has_come_true():
    bench = armed_bench([*[good] * 6])

    def ask_and_fail():
        bench.ask(SetReference(operator="ann"))()
        bench.ask(Disarm(operator="ann"))()
        raise SourceLostError("gone")

    bench.source.script.append(after(ask_and_fail))
    bench.run()
    _, reference, disarm = bench.answers
    assert isinstance(reference.exception(timeout=0), CommandRefusedError)
    assert disarm.result(timeout=0) is None


@pytest.mark.parametrize("command", [Arm(operator="ann"), Disarm(operator="ann")], ids=str)
def test_nothing_can_be_asked_after_the_end(command):
    bench = Bench([good]).run()
    with pytest.raises(CommandRefusedError, match="over"):
        bench.loop.submit(command)


def test_a_loop_that_was_never_started_can_be_stopped():
    bench = Bench([good])
    assert bench.loop.stop(timeout_s=0.1) is True
    with pytest.raises(CommandRefusedError, match="never started"):
        bench.loop.submit(Arm(operator="ann"))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_even_a_thread_that_is_torn_down_holds_first():
    class TornDownError(BaseException):
        """Not an Exception: nothing in the loop catches it."""

    bench = armed_bench([*[good] * 6, raising(TornDownError())]).run()
    assert bench.hold_reason_of_the_line() is HoldReason.ENGINE_FAILED
    assert bench.source.line_was_on_at_close is False
    assert bench.loop.status.run_state is LoopStatus.FAILED


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_the_line_is_held_before_the_end_is_decided_on_or_reported():
    bench = armed_bench([*[good] * 6, raising(SourceLostError("gone"))])

    def fail(*_arguments):
        raise RuntimeError("telling failed")

    bench.loop._decide_last = fail
    bench.run()
    assert bench.hold_reason_of_the_line() is HoldReason.SOURCE_LOST
    assert bench.source.closed == 1


def test_the_engine_leaves_no_thread_behind():
    before = set(threading.enumerate())
    bench = Bench([good] * 3 + [raising(FrameTimeoutError("late"))]).run()
    assert bench.loop.stop(timeout_s=1.0)
    assert {thread for thread in threading.enumerate() if thread.name.startswith("tidegate")} <= before
