"""An engine's life to the last instant: how long it listens, what it is made with, and the words it ends with."""

from dataclasses import replace

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.control.loop import EngineLoop
from engine.control.outputs import LoopStatus
from engine.control.session import FIRST_FRAME_NS
from engine.core.clock import NS_PER_S, ManualClock
from engine.core.commands import Acknowledge, Arm, Disarm, HoldBeam
from engine.core.errors import (
    CommandRefusedError,
    FrameTimeoutError,
    RecordingError,
    SourceAwayError,
    SourceEndedError,
    SourceLostError,
)
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import armed_bench
from tests.support.control.loop_bench import (
    Bench,
    RecordingPipeline,
    ScriptedSource,
    WatchedBeamLine,
    after,
    good,
    raising,
    silent,
)
from tests.support.gating.streams import LIMITS, MS, PERIOD_NS, START_NS


def quiet_for(duration_ns):
    """Nothing comes for so long, whatever was asked for."""

    def step(source, _timeout_s):
        source.clock.advance_ns(duration_ns)
        raise FrameTimeoutError("nothing came")

    return step


def plain_loop(**options):
    clock = ManualClock(START_NS)
    pipeline = RecordingPipeline(clock)
    return EngineLoop(
        source=ScriptedSource(clock, []),
        measurer=pipeline,
        learner=pipeline,
        beam=SimulatedBeamLine(clock),
        limits=LIMITS,
        clock=clock,
        **options,
    )


@pytest.mark.parametrize(
    ("quiet_ns", "status"), [(FIRST_FRAME_NS, LoopStatus.ENDED), (FIRST_FRAME_NS + 1, LoopStatus.FAILED)]
)
def test_a_source_that_shows_nothing_is_listened_to_for_ten_seconds_since_it_was_opened(quiet_ns, status):
    assert FIRST_FRAME_NS == 10 * NS_PER_S
    bench = Bench([quiet_for(quiet_ns)]).run()
    assert bench.loop.status.run_state is status


def test_a_source_that_has_shown_something_is_not_lost_for_a_silence_however_old_the_session_is():
    bench = Bench([*[good] * 320, silent, *[good] * 3]).run()
    assert bench.clock.now_ns() - START_NS > FIRST_FRAME_NS
    assert (bench.loop.status.run_state, bench.loop.status.error) == (LoopStatus.ENDED, None)


def test_a_source_that_shows_nothing_is_listened_to_for_as_long_as_a_gap_may_be():
    asked_s = []

    def listen(source, timeout_s):
        asked_s.append(timeout_s)
        return silent(source, timeout_s)

    Bench([listen] * 3).run()
    assert asked_s == [0.06] * 3


@pytest.mark.parametrize(
    ("spent_ns", "asked_ns"),
    [
        (5 * MS, 55 * MS),
        (59 * MS, 1 * MS),
        (59 * MS + 1, 60 * MS),
        (60 * MS, 60 * MS),
        (90 * MS, 60 * MS),
    ],
)
def test_a_frame_is_awaited_until_it_is_missing_but_never_for_less_than_a_millisecond(spent_ns, asked_ns):
    """What was spent counts since the last frame was received; where nothing is left, the whole of a gap is granted."""
    bench = Bench([good])
    asked_s = []

    def listen(source, timeout_s):
        asked_s.append(timeout_s)
        return silent(source, timeout_s)

    def dawdle(frame):
        bench.clock.advance_ns(spent_ns - (bench.clock.now_ns() - frame.received_ns))
        return frame

    bench.pipeline.spoil[0] = dawdle
    bench.source.script.append(listen)
    bench.run()
    assert asked_s == [pytest.approx(asked_ns / NS_PER_S, rel=1e-12)]


def test_its_queues_have_the_set_length_and_by_default_half_a_minute_of_samples():
    loop = plain_loop()
    assert (loop.samples.maxsize, loop.transitions.maxsize, loop.notices.maxsize) == (900, 256 + 4, 64)
    small = plain_loop(sample_capacity=7, transition_capacity=9, command_capacity=2)
    assert (small.samples.maxsize, small.transitions.maxsize) == (7, 9 + 4)
    for asked, capacity in ((small, 2), (loop, 16)):
        for _ in range(capacity):
            asked.submit(Arm(operator="ann"))
        with pytest.raises(CommandRefusedError, match=f"^{capacity} commands wait already"):
            asked.submit(Arm(operator="ann"))
        asked.submit(Disarm(operator="ann"))
        asked.submit(HoldBeam(operator="ann"))


def test_its_thread_is_named_and_keeps_no_process_alive_and_its_watchdog_has_the_site_s_deadline():
    loop = plain_loop()
    assert (loop._thread.name, loop._thread.daemon) == ("tidegate-engine", True)
    assert loop._watchdog._deadline_ns == 200 * MS


def test_an_engine_that_was_never_started_states_it_in_these_words():
    loop = plain_loop()
    assert loop.stop(timeout_s=0.0) is True
    with pytest.raises(CommandRefusedError, match=r"^the engine was never started$"):
        loop.submit(Arm(operator="ann"))


def test_an_engine_that_hangs_states_it_in_these_words_and_its_line_is_held_as_stopped():
    loop = plain_loop()

    class Hanging:
        ident = 1
        joined: list[float] = []  # noqa: RUF012 - one for one test

        def join(self, timeout):
            self.joined.append(timeout)

        def is_alive(self):
            return True

    loop._thread = Hanging()
    assert loop.stop(timeout_s=0.25) is False
    assert Hanging.joined == [0.25]
    with pytest.raises(CommandRefusedError, match=r"^the engine hangs; the beam is held$"):
        loop.submit(Arm(operator="ann"))
    assert loop.join(timeout_s=0.5) is False
    assert Hanging.joined == [0.25, 0.5]


def test_what_waits_at_the_end_is_refused_in_these_words():
    bench = Bench([good]).run()
    with pytest.raises(CommandRefusedError, match=r"^the session is over$"):
        bench.loop.submit(Arm(operator="ann"))


@pytest.mark.parametrize(
    ("error", "reason", "text"),
    [
        (SourceEndedError("the last frame was shown"), HoldReason.SOURCE_ENDED, "the last frame was shown"),
        (SourceEndedError(), HoldReason.SOURCE_ENDED, "SourceEndedError"),
        (SourceLostError("unplugged"), HoldReason.SOURCE_LOST, "unplugged"),
        (RecordingError("cut"), HoldReason.SOURCE_LOST, "cut"),
        (ZeroDivisionError("oh"), HoldReason.ENGINE_FAILED, "ZeroDivisionError: oh"),
    ],
    ids=["ended", "ended without a word", "lost", "cut", "a bug"],
)
def test_the_gate_keeps_the_words_that_the_end_came_with(error, reason, text):
    bench = armed_bench([good, raising(error)]).run()
    assert (bench.loop.gate.reason, bench.loop.gate.detail) == (reason, text)


def test_a_thread_that_is_torn_down_states_it():
    bench = armed_bench([good])

    def tear_down(_source, _timeout_s):
        raise KeyboardInterrupt

    bench.source.script.append(tear_down)
    bench.loop._thread = type("None", (), {"ident": 1})()
    with pytest.raises(KeyboardInterrupt):
        bench.loop._work()
    assert bench.loop.status.error == "the engine thread was ended"
    assert (bench.loop.gate.reason, bench.loop.gate.detail) == (
        HoldReason.ENGINE_FAILED,
        "the engine thread was ended",
    )


@pytest.mark.parametrize(
    ("change", "reason", "detail"),
    [
        ({"model": None}, HoldReason.MODEL_MISSING, ""),
        ({"has_reference": False}, HoldReason.REFERENCE_MISSING, ""),
        ({"model_generation": 9}, HoldReason.DISARMED, ""),
    ],
    ids=["no model", "no zero", "another model"],
)
def test_what_stands_against_the_beam_is_named(change, reason, detail):
    bench = armed_bench([*[good] * 5])

    def do():
        for name, value in change.items():
            setattr(bench.pipeline, name, value)

    seen = []
    bench.source.script += [after(do), after(lambda: seen.append(bench.loop.gate))]
    bench.run()
    assert (seen[0].reason, seen[0].detail) == (reason, detail)
    assert seen[0].state is (GateState.DISARMED if reason is HoldReason.DISARMED else GateState.HOLD)


def test_another_model_is_named_as_the_cause_where_nothing_else_was_asked():
    bench = armed_bench([*[good] * 5])
    bench.source.script += [after(lambda: setattr(bench.pipeline, "model_generation", 9)), good]
    change = next(change for change in bench.run().transitions() if change.to_state is GateState.DISARMED)
    assert (change.reason, change.frame_index) == (HoldReason.DISARMED, 9)


@pytest.mark.parametrize("field", ["frame_index", "timestamp_us", "received_ns", "missed_frames"])
def test_a_measurement_that_is_not_its_frame_s_in_any_way_faults_by_name(field):
    bench = armed_bench([*[good] * 6])
    spoiled = {"frame_index": 2, "timestamp_us": 1, "received_ns": -1, "missed_frames": 1}
    bench.pipeline.spoil[8] = lambda frame: replace(frame, **{field: getattr(frame, field) + spoiled[field]})
    fault = next(change for change in bench.run().transitions() if change.to_state is GateState.FAULT)
    assert (fault.reason, fault.detail) == (HoldReason.VALUE_INVALID, "a measurement of another frame")


def test_a_camera_that_does_not_open_leaves_a_line_that_was_held_and_closed():
    class Noting(WatchedBeamLine):
        def __init__(self, clock):
            super().__init__(clock)
            self.holds = []

        def hold(self, reason):
            self.holds.append(reason)
            super().hold(reason)

    bench = Bench([], beam=Noting)
    bench.source.open = lambda: (_ for _ in ()).throw(SourceLostError("no camera"))
    bench.run()
    assert bench.beam.holds[:2] == [HoldReason.DISARMED, HoldReason.SOURCE_LOST]
    assert not bench.beam._is_open
    assert bench.clock.now_ns() - START_NS < PERIOD_NS


def test_a_camera_that_is_away_is_reported_in_its_own_words():
    def away(source, timeout_s):
        source.clock.advance_ns(round(timeout_s * NS_PER_S))
        raise SourceAwayError("pulled out of port 3")

    bench = armed_bench([good, away]).run()
    fault = next(change for change in bench.transitions() if change.to_state is GateState.FAULT)
    assert (fault.reason, fault.detail) == (HoldReason.SOURCE_LOST, "pulled out of port 3")


def test_a_model_that_has_grown_old_holds_though_every_frame_is_good():
    bench = Bench([good], limits=replace(LIMITS, max_model_age_min=1.0))
    bench.source.script += [quiet_for(61 * NS_PER_S), *[good] * 40]
    bench.source.script += [after(bench.ask(Acknowledge(operator="ann"))), good]
    bench.source.script += [after(bench.ask(Arm(operator="ann"))), *[good] * 8]
    last = bench.run().records()[-1]
    assert (last.gate_state, last.hold_reason, last.line_on) == (GateState.HOLD, HoldReason.MODEL_OLD, False)
