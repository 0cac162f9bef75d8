"""An engine in a process of its own, with a line in another.

Run: ``python -m tests.support.beam.engine_program KIND WHERE``.

It arms itself and runs until it is killed, and writes each transition as a line. An engine whose line answers late when
it is opened, on a busy machine, is followed by another.
"""

import contextlib
import os
import queue
import sys
from pathlib import Path

from engine.beam.line import BeamLine
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.control.loop import EngineLoop
from engine.core.clock import Clock, MonotonicClock
from engine.core.commands import Acknowledge, Arm
from engine.core.errors import BeamLineError, CommandRefusedError
from engine.core.gate_state import GateState
from tests.support.beam.datagram_line import DatagramBeamLine
from tests.support.beam.receivers import TIMES, wire_to
from tests.support.control.loop_bench import RecordingPipeline, drained
from tests.support.control.real_time_source import PATIENT_LIMITS, PacedSource


def beam_line(kind: str, where: str, clock: Clock) -> BeamLine:
    if kind == "datagram":
        return DatagramBeamLine(Path(where), clock, reply_ms=500.0)
    return WiredBeamLine(wire_to(kind, where), clock, TIMES)


def main(kind: str, where: str) -> None:
    parent = os.getppid()
    while os.getppid() == parent:  # ends with its parent
        run_one_life(kind, where)


def run_one_life(kind: str, where: str) -> None:
    clock = MonotonicClock()
    pipeline = RecordingPipeline(clock)
    loop = EngineLoop(
        source=PacedSource(clock),
        measurer=pipeline,
        learner=pipeline,
        beam=beam_line(kind, where, clock),
        limits=PATIENT_LIMITS,
        clock=clock,
    )
    loop.start()
    while not loop.status.is_over:
        drained(loop.samples)
        if not loop.gate.is_armed:
            _arm(loop)
        with contextlib.suppress(queue.Empty):
            change = loop.transitions.get(timeout=0.05)
            sys.stdout.write(f"{change.to_state} {change.reason} {change.at_ns}\n")
            sys.stdout.flush()


def _arm(loop: EngineLoop) -> None:
    """Do as an operator does who clears every fault; refused until there is a frame, and tried again."""
    with contextlib.suppress(CommandRefusedError, BeamLineError):
        if loop.gate.state is GateState.FAULT:
            loop.submit(Acknowledge(operator="ann")).result(timeout=5.0)
        loop.submit(Arm(operator="ann")).result(timeout=5.0)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
