"""A real engine on a line with a real receiver: what the line finds out reaches the gate, and a person can go on."""

import queue
import time

import pytest

from engine.beam.compared_line import ComparedBeamLine
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.control.loop import EngineLoop, LoopStatus
from engine.core.clock import MonotonicClock
from engine.core.commands import Acknowledge, Arm, Disarm, HoldBeam, ReleaseBeam
from engine.core.errors import BeamLineError, CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from tests.support.beam.receivers import REGISTERS, TIMES, WITH_BEAM_ON, receiver, wire_to
from tests.support.control.loop_bench import RecordingPipeline, drained
from tests.support.control.real_time_source import PATIENT_LIMITS, PacedSource
from tests.support.waiting import eventually

pytestmark = pytest.mark.alone

PATIENCE_S = 20.0
TRIES = 4


class Room:
    """An engine and the receiver at the end of its line."""

    def __init__(self, far, registers=REGISTERS):
        self.far, self.registers = far, registers
        self.loop = self._running()

    def _running(self):
        """An engine whose line was opened; where its receiver answered late, on a busy machine, another one."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            loop = _engine(wire_to(self.far.kind, self.far.where, self.registers), TIMES)
            loop.start()
            eventually(lambda loop=loop: loop.status.run_state is not LoopStatus.STARTING, within_s=PATIENCE_S)
            if loop.status.run_state is LoopStatus.RUNNING:
                return loop
            assert time.monotonic() < deadline_s, f"the line never opened: {loop.status.error}"

    def insist(self, command):
        """Ask until it is not refused, as a person does who waits for the line."""
        eventually(lambda: self._obeys(command), within_s=PATIENCE_S, detail=lambda: f"{command} is always refused")

    def _obeys(self, command):
        drained(self.loop.samples)
        try:
            self.loop.submit(command).result(timeout=PATIENCE_S)
        except (BeamLineError, CommandRefusedError):
            return False
        return True

    def arm(self):
        """Acknowledge what there is and arm, until the beam is on at both ends, as a person does.

        On a busy machine the line may find itself in trouble at any moment: an acknowledgement is good for one fault.
        """
        eventually(
            self._is_on_or_asks,
            within_s=PATIENCE_S,
            pause_s=0.02,
            detail=lambda: f"the beam does not come on: {self.loop.gate.detail}",
        )
        drained(self.far._lines)
        drained(self.loop.transitions)

    def _is_on_or_asks(self):
        if self.is_on():
            return True
        if self.loop.gate.state is GateState.FAULT:
            self._obeys(Acknowledge(operator="ann"))
        elif not self.loop.gate.is_armed:
            self._obeys(Arm(operator="ann"))
        drained(self.loop.samples)
        return False

    def is_on(self):
        return self.loop.gate.state is GateState.BEAM_ON and bool(self.far.seen) and self.far.seen[-1][0] == "on"

    def fault(self):
        """The next fault that the gate tells of."""
        while True:
            drained(self.loop.samples)
            change = self.loop.transitions.get(timeout=PATIENCE_S)
            if change.to_state is GateState.FAULT:
                return change

    def fault_of(self, spoiled, reason):
        """The reason of the fault that follows a spoiled receiver; where a busy machine's own came first, again."""
        for _ in range(TRIES):
            self.arm()
            self.far.spoil(spoiled)
            found = self.fault().reason
            self.far.spoil("well")
            if found is reason:
                break
        return found


def _engine(wire, times=None):
    clock = MonotonicClock()
    pipeline = RecordingPipeline(clock)
    line = WiredBeamLine(wire, clock, times)
    beam = ComparedBeamLine(line, clock, lambda: wire.beam_on, after_permit_ms=500.0)
    return EngineLoop(
        source=PacedSource(clock),
        measurer=pipeline,
        learner=pipeline,
        beam=beam,
        beam_on=lambda: beam.state,
        limits=PATIENT_LIMITS,
        clock=clock,
    )


@pytest.fixture
def room():
    with receiver("tcp") as far:
        held = Room(far)
        try:
            yield held
        finally:
            held.loop.stop(PATIENCE_S)


@pytest.mark.parametrize(
    ("spoiled", "reason"),
    [("stuck off", HoldReason.BEAM_LINE_MISMATCH), ("late 180", HoldReason.BEAM_LINE_FAILED)],
)
def test_a_trouble_of_the_line_faults_the_gate_by_name_and_after_acknowledging_and_arming_it_goes_on(
    room, spoiled, reason
):
    found = room.fault_of(spoiled, reason)
    assert found is reason
    assert room.far.next_edge()[0] == "off"
    with pytest.raises(queue.Empty):
        room.far._lines.get(timeout=0.3)
    room.insist(Acknowledge(operator="ann"))
    with pytest.raises(queue.Empty):
        room.far._lines.get(timeout=0.3)  # acknowledging is not arming
    room.arm()


def test_a_line_that_is_unplugged_while_disarmed_faults_too(room):
    room.arm()
    room.insist(Disarm(operator="ann"))
    assert room.far.next_edge()[0] == "off"
    room.far.process.kill()
    assert room.fault().reason is HoldReason.BEAM_LINE_FAILED


def test_a_session_on_a_line_that_is_not_there_fails_and_states_it():
    loop = _engine(wire_to("tcp", "1"))
    loop.start()
    assert loop.join(PATIENCE_S)
    assert "the beam line at 127.0.0.1:1 does not answer" in (loop.status.error or "")


def test_an_engine_that_ends_turns_the_receiver_off_by_telling_it(room):
    room.arm()
    room.loop.stop(PATIENCE_S)
    edge = room.far.next_edge()
    assert (edge[0], edge[2]) == ("off", "command")


@pytest.fixture(params=["tcp", "rtu"])
def compared(request):
    """An engine whose line also reads the accelerator's beam-on signal."""
    with receiver(request.param) as far:
        held = Room(far, WITH_BEAM_ON)
        try:
            yield held
        finally:
            held.loop.stop(PATIENCE_S)


def _fault_after_a_hold(room):
    """Hold by hand while the accelerator's signal stays on; return the fault, of a busy machine's too."""
    room.arm()
    room.far.spoil("beam on")
    room.insist(HoldBeam(operator="ann"))
    return room.fault().reason


def test_a_beam_that_stays_on_after_a_hold_is_a_fault_that_lasts_as_long_as_the_beam(compared):
    for _ in range(TRIES):
        found = _fault_after_a_hold(compared)
        if found is HoldReason.BEAM_WITHOUT_PERMIT:
            break
        compared.far.spoil("well")
        compared.insist(ReleaseBeam(operator="ann"))
    assert found is HoldReason.BEAM_WITHOUT_PERMIT
    compared.insist(Acknowledge(operator="ann"))
    assert compared.fault().reason is HoldReason.BEAM_WITHOUT_PERMIT
    compared.far.spoil("well")
    compared.insist(ReleaseBeam(operator="ann"))
    compared.arm()


def test_a_beam_that_follows_the_permit_holds_nothing_and_each_hold_is_timed(compared):
    compared.arm()
    compared.insist(HoldBeam(operator="ann"))

    def is_timed():
        drained(compared.loop.samples)
        view = compared.loop.status.view
        return view is not None and view.beam_on is not None and view.beam_on.offs >= 1

    eventually(is_timed, within_s=PATIENCE_S, detail=lambda: f"no hold was timed: {compared.loop.gate.detail}")
    assert compared.loop.status.view.beam_on.last_off_ms > 0.0
    assert compared.loop.gate.reason is not HoldReason.BEAM_WITHOUT_PERMIT
