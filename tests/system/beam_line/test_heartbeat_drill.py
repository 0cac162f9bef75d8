"""The drill of the heartbeat against real receivers in processes of their own, with and without their rules."""

import contextlib
import threading

import pytest

from engine.beam.commissioning import Pulser
from engine.beam.heartbeat_drill import HeartbeatDrill
from engine.beam.paired import PairedBeamLine
from engine.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason
from engine.qa.drill import drill_line
from engine.qa.inputs import BeamInput
from tests.support.beam.modbus_server import DROP_NS
from tests.support.beam.receivers import TIMES, Lateness, drilled_part, open_patiently, receiver

KINDS = ["tcp", "rtu", "lcus", "lcus-text", "numato"]
ATTEMPTS = 20
FAULTS = {
    "keeps": "the contact stayed closed for 500 ms",
    "recloses": "the contact closed again with the next heartbeats",
}
BUSY = ("did not stand still", "never read back", "was commanded", "good answers", "answer", "latched", "lapsed")
"""What the drill says where a busy machine, not the receiver, kept it from its result."""


def _wait_ns(span_ns):
    threading.Event().wait(span_ns / NS_PER_S)


def _drilled(line, drilled):
    """Return the time [ms], or the receiver's failure; tried again where the machine was too busy for a result."""
    clock = MonotonicClock()
    for _ in range(ATTEMPTS):
        pulser = Pulser(line, clock, pulse_ms=200.0, wait_ns=_wait_ns)
        drill = HeartbeatDrill(pulser, clock, _wait_ns)
        with contextlib.closing(line):
            open_patiently(line)
            try:
                pulser.arm()
                return drill.open_ms(drilled)
            except BeamLineError as error:
                if not any(words in str(error) for words in BUSY):
                    return str(error)
            finally:
                line.hold(HoldReason.OPERATOR_HOLD)
    return "the machine was too busy"


@pytest.mark.parametrize("kind", KINDS)
def test_a_receiver_that_follows_the_rules_is_seen_to_open_by_its_heartbeat_alone(kind):
    with receiver(kind) as far, Lateness() as busy:
        line, drilled = drilled_part(far)
        taken_ms = _drilled(line, drilled)
        assert isinstance(taken_ms, float), taken_ms
        assert taken_ms <= DROP_NS / NS_PER_MS + TIMES.answer_ms + busy.allowed_ns / NS_PER_MS
        assert ["heartbeat"] in [edge[2:] for edge in far.seen]


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_receiver_without_the_rule_fails_and_is_off_afterwards(kind, fault):
    with receiver(kind) as far:
        far.spoil(fault)
        line, drilled = drilled_part(far)
        failure = _drilled(line, drilled)
        assert isinstance(failure, str), failure
        assert failure.startswith(f"{kind}: {FAULTS[fault]}")
        assert far.next_edge()[0] == "on"
        while far.is_on:
            far.next_edge()


@pytest.mark.parametrize("faulty", [None, 0, 1], ids=["both good", "first", "second"])
def test_of_two_lines_each_receiver_is_drilled_while_the_other_is_good(faulty):
    with receiver("tcp") as first, receiver("lcus") as second:
        far = (first, second)
        if faulty is not None:
            far[faulty].spoil("keeps")
        (line_1, drilled_1), (line_2, drilled_2) = drilled_part(first), drilled_part(second)
        pair = PairedBeamLine(line_1, line_2)
        for number, drilled in enumerate((drilled_1, drilled_2)):
            result = _drilled(pair, drilled)
            if number == faulty:
                assert result == f"{far[number].kind}: {FAULTS['keeps']} after the heartbeat stood still"
            else:
                assert isinstance(result, float), result


@pytest.mark.parametrize("fault", [None, "keeps"])
def test_daily_qa_fails_a_receiver_without_the_rule_and_passes_one_with_it(fault):
    with receiver("tcp") as far:
        for _ in range(ATTEMPTS):
            if fault is not None:
                far.spoil(fault)
            line, drilled = drilled_part(far)
            given = BeamInput(line=line, clock=MonotonicClock(), wait_ns=_wait_ns, repeats=5, receivers=(drilled,))
            figures = {figure.code: figure for figure in drill_line(given, lambda _done: None)}
            figure = figures["fail_safe_heartbeat_ms"]
            is_measured = figure.value is not None or FAULTS["keeps"] in figure.detail
            if is_measured:
                break
        assert is_measured, figure.detail
        assert (figure.value is None) is (fault is not None)
