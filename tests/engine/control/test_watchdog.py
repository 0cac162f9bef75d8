"""The watchdog: stepped without a thread, and with real threads against a source that hangs as a driver does."""

import contextlib
import queue

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.control.loop import EngineLoop
from engine.control.outputs import GateTransition
from engine.control.watchdog import Watchdog
from engine.core.clock import ManualClock, MonotonicClock
from engine.core.commands import Acknowledge, Arm, Disarm
from engine.core.errors import BeamLineError, CommandRefusedError
from engine.core.gate_state import GateState, HoldReason, Lease
from tests.support.control.loop_bench import RecordingPipeline, drained
from tests.support.control.real_time_source import PATIENT_LIMITS, PacedSource
from tests.support.waiting import eventually

MS = 1_000_000
DEADLINE_NS = 100 * MS
PATIENCE_S = 20.0


def _watched() -> tuple[Watchdog, SimulatedBeamLine, ManualClock, list[int]]:
    clock = ManualClock(1_000 * MS)
    line = SimulatedBeamLine(clock)
    line.open()
    line.rearm()
    watchdog, fired = Watchdog(beam=line, clock=clock, deadline_ns=DEADLINE_NS), []
    watchdog.on_fired = fired.append
    line.permit(Lease(granted_ns=clock.now_ns(), expires_ns=clock.now_ns() + 200 * MS, sequence=1))
    watchdog.feed(clock.now_ns(), is_armed=True)
    return watchdog, line, clock, fired


def test_it_holds_just_after_its_deadline_and_states_it_once():
    watchdog, line, clock, fired = _watched()
    clock.advance_ns(DEADLINE_NS)
    assert not watchdog.check(clock.now_ns())
    assert line.is_on()
    clock.advance_ns(1)
    assert watchdog.check(clock.now_ns())
    assert not line.is_on()
    assert line.edges[-1].reason is HoldReason.WATCHDOG
    assert watchdog.check(clock.now_ns())
    assert fired == [clock.now_ns()]


def test_each_decision_begins_the_deadline_anew():
    watchdog, line, clock, _ = _watched()
    for _ in range(3):
        clock.advance_ns(60 * MS)
        watchdog.feed(clock.now_ns(), is_armed=True)
        assert not watchdog.check(clock.now_ns())
    assert not watchdog.has_fired
    assert line.edges[0].is_on


def test_a_disarmed_gate_needs_no_watching():
    watchdog, _, clock, _ = _watched()
    watchdog.feed(clock.now_ns(), is_armed=False)
    clock.advance_ns(10 * DEADLINE_NS)
    assert not watchdog.check(clock.now_ns())


def test_once_it_has_fired_no_feeding_and_no_permit_brings_the_beam_back():
    watchdog, line, clock, _ = _watched()
    clock.advance_ns(DEADLINE_NS + 1)
    watchdog.check(clock.now_ns())
    clock.advance_ns(MS)
    watchdog.feed(clock.now_ns(), is_armed=True)
    assert watchdog.has_fired
    with pytest.raises(BeamLineError, match="latched"):
        line.permit(Lease(granted_ns=clock.now_ns(), expires_ns=clock.now_ns() + MS, sequence=2))
    watchdog.reset()
    with pytest.raises(BeamLineError, match="latched"):
        line.permit(Lease(granted_ns=clock.now_ns(), expires_ns=clock.now_ns() + MS, sequence=3))


def test_it_marks_itself_before_it_holds_so_that_an_arming_engine_sees_one_or_the_other():
    seen = []

    class Noting(SimulatedBeamLine):
        def hold(self, reason):
            seen.append(watchdog.has_fired)
            super().hold(reason)

    clock = ManualClock(0)
    watchdog = Watchdog(beam=Noting(clock), clock=clock, deadline_ns=DEADLINE_NS)
    watchdog.feed(0, is_armed=True)
    watchdog.check(DEADLINE_NS + 1)
    assert seen == [True]


class _Noted:
    """An event that is set after a few waits, and notes how long each was to be."""

    def __init__(self, waits: int) -> None:
        self.waits: list[float] = []
        self._left = waits

    def wait(self, seconds: float) -> bool:
        self.waits.append(seconds)
        self._left -= 1
        return self._left < 0


def test_it_looks_ten_times_within_its_deadline_by_its_own_clock_until_it_is_stopped():
    watchdog, line, clock, fired = _watched()
    clock.advance_ns(DEADLINE_NS + 1)
    watchdog._stop_requested = _Noted(3)
    watchdog._watch()
    assert watchdog._stop_requested.waits == [0.01] * 4
    assert fired == [clock.now_ns()]
    assert not line.is_on()


def test_its_thread_is_named_and_keeps_no_process_alive_and_is_waited_for_when_it_is_stopped():
    watchdog = _watched()[0]
    watchdog.stop()
    assert (watchdog._thread.name, watchdog._thread.daemon) == ("tidegate-watchdog", True)
    assert not watchdog.is_watching
    other = _watched()[0]
    other.start()
    assert other.is_watching
    other.stop()
    assert not other.is_watching


def test_a_reset_forgets_both_that_it_fired_and_since_when_somebody_was_armed():
    watchdog, _, clock, fired = _watched()
    clock.advance_ns(DEADLINE_NS + 1)
    assert watchdog.check(clock.now_ns())
    watchdog.reset()
    assert not watchdog.has_fired
    clock.advance_ns(10 * DEADLINE_NS)
    assert not watchdog.check(clock.now_ns())
    assert len(fired) == 1


def test_its_end_is_waited_for_a_second_or_the_given_time_and_no_longer():
    class Hanging:
        joined: list[float] = []  # noqa: RUF012 - one for one test

        def is_alive(self):
            return True

        def join(self, timeout):
            self.joined.append(timeout)

    watchdog = _watched()[0]
    watchdog._thread = Hanging()
    watchdog.stop()
    watchdog.stop(timeout_s=0.25)
    assert Hanging.joined == [1.0, 0.25]


def test_it_works_without_a_listener():
    clock = ManualClock(0)
    watchdog = Watchdog(beam=SimulatedBeamLine(clock), clock=clock, deadline_ns=DEADLINE_NS)
    watchdog.feed(0, is_armed=True)
    assert watchdog.check(DEADLINE_NS + 1)


def _wait_for(transitions: "queue.Queue[GateTransition]", state: GateState) -> GateTransition:
    while True:
        change = transitions.get(timeout=PATIENCE_S)
        if change.to_state is state:
            return change


def _turn_on(loop: EngineLoop, line: SimulatedBeamLine, operator: str) -> None:
    """Do as a person does until the beam is on: a busy machine may fault or hold by itself meanwhile."""

    def is_on() -> bool:
        if loop.gate.state is GateState.BEAM_ON and line.is_on():
            return True
        drained(loop.samples)
        with contextlib.suppress(CommandRefusedError):
            if loop.gate.state is GateState.FAULT:
                loop.submit(Acknowledge(operator=operator)).result(timeout=PATIENCE_S)
            if not loop.gate.is_armed:
                loop.submit(Arm(operator=operator)).result(timeout=PATIENCE_S)
        return False

    eventually(
        is_on,
        within_s=PATIENCE_S,
        pause_s=0.01,
        detail=lambda: f"the beam does not come on: {loop.gate.reason} {loop.gate.detail}",
    )


@pytest.fixture
def running():
    """A real engine with real threads, armed and on, and the source to hang it with."""
    clock = MonotonicClock()
    source, line = PacedSource(clock), SimulatedBeamLine(clock)
    pipeline = RecordingPipeline(clock)
    loop = EngineLoop(source=source, measurer=pipeline, learner=pipeline, beam=line, limits=PATIENT_LIMITS, clock=clock)
    loop.start()
    try:
        _turn_on(loop, line, "ann")
        yield loop, source, line
    finally:
        source.released.set()
        assert loop.stop(timeout_s=PATIENCE_S)


def _hang(loop: EngineLoop, source: PacedSource, line: SimulatedBeamLine) -> None:
    """Hang the engine with its beam on; where a busy machine had just held it, let it go and try again."""
    while True:
        drained(loop.transitions)
        source.hangs.set()
        assert source.is_hanging.wait(PATIENCE_S)
        if loop.gate.state is GateState.BEAM_ON:
            return
        source.hangs.clear()
        source.is_hanging.clear()
        source.released.set()
        source.released.clear()
        _turn_on(loop, line, "ann")


def test_a_source_that_hangs_in_its_driver_ends_in_beam_off_and_a_reported_fault(running):
    loop, source, line = running
    _hang(loop, source, line)
    fault = _wait_for(loop.transitions, GateState.FAULT)
    assert (fault.reason, fault.from_state) == (HoldReason.WATCHDOG, GateState.BEAM_ON)
    assert not line.is_on()
    view = loop.status.view
    assert (view.record.gate_state, view.record.hold_reason) == (GateState.FAULT, HoldReason.WATCHDOG)
    assert not view.is_armed
    assert view.record.line_on  # as it was read last: no one has read it back since it was held
    assert loop.status.view is view  # readers tell news by identity: a hung engine has none


def test_an_engine_that_comes_back_stays_faulted_until_acknowledged_and_armed(running):
    loop, source, line = running
    _hang(loop, source, line)
    _wait_for(loop.transitions, GateState.FAULT)
    source.hangs.clear()
    source.released.set()
    drained(loop.samples)
    states = [loop.samples.get(timeout=PATIENCE_S).gate_state for _ in range(8)]
    assert set(states) == {GateState.FAULT}
    assert drained(loop.transitions) == []  # emitted once, by the watchdog
    assert not line.is_on()
    loop.submit(Acknowledge(operator="bob")).result(timeout=PATIENCE_S)
    assert _wait_for(loop.transitions, GateState.DISARMED).operator == "bob"
    _turn_on(loop, line, "bob")
    loop.submit(Disarm(operator="bob")).result(timeout=PATIENCE_S)
    assert not line.is_on()


def test_stopping_a_hung_engine_latches_and_closes_the_line_and_states_that_it_hangs(running):
    loop, source, line = running
    _hang(loop, source, line)
    waiting = loop.submit(Disarm(operator="ann"))
    assert loop.stop(timeout_s=0.0) is False
    assert not line.is_on()
    assert waiting.result(timeout=PATIENCE_S) is None
    now_ns = MonotonicClock().now_ns()
    with pytest.raises(BeamLineError, match="closed"):  # nothing of it goes on beside the next session's line
        line.permit(Lease(granted_ns=now_ns, expires_ns=now_ns + MS, sequence=10**9))
