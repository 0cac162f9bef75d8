"""An engine in a process of its own, with a line in another: ``python -m tests.beam.engine_process KIND WHERE``.

It arms itself and runs until it is killed, and writes each transition as a line. An engine whose line answers late when
it is opened, on a busy machine, is followed by another.
"""

import contextlib
import os
import queue
import sys
from pathlib import Path

from engine.beam.datagram import DatagramBeamLine
from engine.beam.line import BeamLine
from engine.beam.wired import WiredBeamLine
from engine.clock import Clock, MonotonicClock
from engine.commands import Acknowledge, Arm
from engine.errors import BeamLineError, CommandRefusedError
from engine.loop import EngineLoop
from engine.permits import GateState
from tests.beam.receivers import TIMES, wire_to
from tests.loop.fakes import ToldPipeline, drained
from tests.loop.paced import PATIENT_LIMITS, PacedSource


def beam_line(kind: str, where: str, clock: Clock) -> BeamLine:
    if kind == "datagram":
        return DatagramBeamLine(Path(where), clock, reply_ms=500.0)
    return WiredBeamLine(wire_to(kind, where), clock, TIMES)


def main(kind: str, where: str) -> None:
    parent = os.getppid()
    while os.getppid() == parent:  # whoever wanted it is there
        run_one_life(kind, where)


def run_one_life(kind: str, where: str) -> None:
    clock = MonotonicClock()
    loop = EngineLoop(
        source=PacedSource(clock),
        pipeline=ToldPipeline(clock),
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
