"""The drill over a real protocol, to a receiver in a process of its own, which is who says when the beam was on."""

import threading
import time
from itertools import pairwise

import pytest

from engine.beam.heartbeat_drill import DrilledReceiver
from engine.beam.wire.modbus import ModbusInput
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from engine.qa.drill import DRILLS, drill_line
from engine.qa.inputs import BeamInput
from tests.support.beam.modbus_server import DROP_NS
from tests.support.beam.receivers import PATIENCE_S, TIMES, Lateness, receiver, wire_to

pytestmark = pytest.mark.waiting

PULSE_MS = 200.0
REPEATS = 5
ATTEMPTS = 20


def _drilled(far):
    clock = MonotonicClock()
    line = WiredBeamLine(wire_to(far.kind, far.where), clock, TIMES)
    second_input = ModbusInput(wire_to(far.kind, far.where))
    given = BeamInput(
        line=line,
        clock=clock,
        wait_ns=lambda ns: threading.Event().wait(ns / NS_PER_S),
        pulse_ms=PULSE_MS,
        repeats=REPEATS,
        receivers=(DrilledReceiver(name="modbus-tcp", line=line, second_input=second_input),),
    )
    return {figure.code: figure for figure in drill_line(given, lambda _done: None)}


def _completed(figures):
    """The drills done as often as asked for; a busy machine keeps one from it, which then has no value."""
    return {name for name in DRILLS if figures[f"fail_safe_{name}_ms"].value is not None}


def _await_reported_off(far):
    """Let the receiver's last word come through its pipe."""
    deadline_s = time.monotonic() + PATIENCE_S
    while far.is_on:
        assert time.monotonic() < deadline_s, "the receiver stayed on"
        threading.Event().wait(0.02)


def test_a_receiver_is_never_on_for_longer_than_a_lease_and_off_at_the_end():
    with receiver("tcp") as far, Lateness() as busy:
        completed = set()
        for _ in range(ATTEMPTS):
            completed |= _completed(_drilled(far))
            if completed == set(DRILLS):
                break
        assert completed == set(DRILLS)
        _await_reported_off(far)
        seen = list(far.seen)
        longest_ns = max(int(off[1]) - int(on[1]) for on, off in pairwise(seen) if on[0] == "on" and off[0] == "off")
        assert sum(edge[0] == "on" for edge in seen) >= REPEATS * len(DRILLS)
        assert longest_ns <= PULSE_MS * NS_PER_MS + DROP_NS + busy.allowed_ns
