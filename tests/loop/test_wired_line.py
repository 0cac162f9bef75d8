"""A real engine on a line with a real receiver: what the line finds out reaches the gate, and a person can go on."""

import queue
import time

import pytest

from engine.beam.wired import WiredBeamLine
from engine.clock import MonotonicClock
from engine.commands import Acknowledge, Arm, Disarm
from engine.errors import BeamLineError, CommandRefusedError
from engine.loop import EngineLoop
from engine.permits import GateState, HoldReason
from tests.beam.receivers import TIMES, receiver, wire_to
from tests.loop.fakes import ToldPipeline, drained
from tests.loop.paced import PATIENT_LIMITS, PacedSource

PATIENCE_S = 20.0


class Room:
    """An engine and the receiver at the end of its line."""

    def __init__(self, far):
        self.far = far
        clock = MonotonicClock()
        self.line = WiredBeamLine(wire_to(far.kind, far.where), clock, TIMES)
        self.loop = EngineLoop(
            source=PacedSource(clock),
            pipeline=ToldPipeline(clock),
            beam=self.line,
            limits=PATIENT_LIMITS,
            clock=clock,
        )
        self.loop.start()

    def insist(self, command):
        """Ask until it is not refused, as a person does who waits for the line."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            drained(self.loop.samples)
            try:
                self.loop.submit(command).result(timeout=PATIENCE_S)
            except (BeamLineError, CommandRefusedError):
                assert time.monotonic() < deadline_s
                time.sleep(0.02)
            else:
                return

    def arm(self):
        """Arm until the receiver is on; a busy machine may have made the line give up, then again."""
        while True:
            if self.loop.gate.state is GateState.FAULT:
                self.insist(Acknowledge(operator="ann"))
            self.insist(Arm(operator="ann"))
            if self.far.next_edge()[0] == "on":
                return

    def fault(self):
        """The next fault that the gate tells of."""
        while True:
            drained(self.loop.samples)
            change = self.loop.transitions.get(timeout=PATIENCE_S)
            if change.to_state is GateState.FAULT:
                return change


@pytest.fixture
def room():
    with receiver("tcp") as far:
        held = Room(far)
        yield held
        held.loop.stop(PATIENCE_S)


@pytest.mark.parametrize(
    ("spoiled", "reason"),
    [("stuck off", HoldReason.BEAM_LINE_MISMATCH), ("late 180", HoldReason.BEAM_LINE_FAILED)],
)
def test_a_trouble_of_the_line_faults_the_gate_by_name_and_after_acknowledging_and_arming_it_goes_on(
    room, spoiled, reason
):
    room.arm()
    drained(room.loop.transitions)
    room.far.spoil(spoiled)
    assert room.fault().reason is reason
    room.far.spoil("well")
    assert room.far.next_edge()[0] == "off"
    with pytest.raises(queue.Empty):
        room.far._lines.get(timeout=0.3)
    room.insist(Acknowledge(operator="ann"))
    with pytest.raises(queue.Empty):
        room.far._lines.get(timeout=0.3)  # acknowledging is not arming
    room.arm()


def test_a_line_that_is_pulled_out_while_nobody_is_armed_faults_too(room):
    room.arm()
    room.insist(Disarm(operator="ann"))
    assert room.far.next_edge()[0] == "off"
    room.far.process.kill()
    assert room.fault().reason is HoldReason.BEAM_LINE_FAILED


def test_a_session_on_a_line_that_is_not_there_fails_and_says_so():
    clock = MonotonicClock()
    loop = EngineLoop(
        source=PacedSource(clock),
        pipeline=ToldPipeline(clock),
        beam=WiredBeamLine(wire_to("tcp", "1"), clock),
        limits=PATIENT_LIMITS,
        clock=clock,
    )
    loop.start()
    assert loop.join(PATIENCE_S)
    assert "the beam line at 127.0.0.1:1 does not answer" in (loop.error or "")


def test_an_engine_that_ends_turns_the_receiver_off_by_telling_it(room):
    room.arm()
    room.loop.stop(PATIENCE_S)
    edge = room.far.next_edge()
    assert (edge[0], edge[2]) == ("off", "told")
