"""Real receivers in processes of their own: killed, frozen, late, contrary. What they saw is what counts."""

import contextlib
import itertools
import os
import queue
import signal
import subprocess
import sys
import time

import pytest

from engine.beam.paired import PairedBeamLine
from engine.beam.wire.line_supervisor import DETECTION_MS
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import NS_PER_MS, MonotonicClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason
from tests.support.beam.modbus_server import DROP_NS
from tests.support.beam.receivers import PATIENCE_S, Lateness, open_patiently, opened, receiver, renewed, wire_to
from tests.support.repository import ROOT
from tests.support.waiting import eventually

pytestmark = pytest.mark.waiting

KINDS = ["tcp", "rtu", "lcus", "lcus-text", "numato"]
DETECTION_NS = int(DETECTION_MS * NS_PER_MS)
FAILED, MISMATCH = HoldReason.BEAM_LINE_FAILED, HoldReason.BEAM_LINE_MISMATCH


@pytest.fixture(params=KINDS)
def far(request):
    with receiver(request.param) as held:
        yield held


@pytest.fixture
def busy():
    """How late this machine is, which is asked for as soon as a test is over what it sets up."""
    with Lateness() as held:
        yield held


@pytest.fixture
def renewing(far):
    with renewed(opened(far.kind, far.where)) as held:
        yield held


@pytest.fixture
def lit(far, renewing):
    """Permitted, and seen on by both ends."""
    renewing.turn_on(far)
    return renewing


def _gets_on(far, may_still):
    """Whether the receiver goes on while it may still be hoped for."""
    while may_still():
        with contextlib.suppress(queue.Empty):
            if far._lines.get(timeout=0.1)[0] == "on":
                return True
    return False


def _off_edge(far):
    """The next edge to off: when, and why."""
    edge = far.next_edge()
    assert edge[0] == "off"
    return int(edge[1]), edge[2]


def test_the_receiver_sees_on_while_it_is_permitted_and_off_when_held(far, lit, busy):
    lit.off()
    held_ns = time.monotonic_ns()
    lit.line.hold(HoldReason.OUTSIDE_WINDOW)
    off_ns, cause = _off_edge(far)
    assert cause == "command"
    assert off_ns - held_ns <= DETECTION_NS + busy.allowed_ns
    lit.await_reading(is_on=False)
    assert lit.troubles.empty()


def test_the_receiver_sees_off_when_the_lease_is_not_renewed(far, lit, busy):
    lit.off()
    ended_ns = time.monotonic_ns()
    off_ns, cause = _off_edge(far)
    assert cause == "command"
    assert off_ns - ended_ns <= 200 * NS_PER_MS + busy.allowed_ns
    lit.await_reading(is_on=False)


def test_a_receiver_that_is_killed_latches_the_line(far, lit, busy):
    far.process.kill()
    killed_ns = time.monotonic_ns()
    at_ns, reason, _ = lit.trouble()
    assert at_ns - killed_ns <= DETECTION_NS + busy.allowed_ns
    assert reason is FAILED
    with pytest.raises(BeamLineError):
        lit.line.is_on()
    with pytest.raises(BeamLineError):
        lit.line.rearm()


def test_a_receiver_that_freezes_latches_the_line_and_is_never_on_again_by_itself(far, lit, busy):
    far.stop()
    stopped_ns = time.monotonic_ns()
    at_ns, reason, _ = lit.trouble()
    assert at_ns - stopped_ns <= DETECTION_NS + busy.allowed_ns
    assert reason is FAILED
    far.go_on()
    _off_edge(far)
    _await_answers(lit)
    with pytest.raises(queue.Empty):
        far._lines.get(timeout=0.4)  # permits rain on meanwhile, and the connection is there again
    lit.arm()
    lit.turn_on(far)


def _await_answers(renewing):
    """Wait until the line answers again; it stays latched."""

    def answers() -> bool:
        try:
            renewing.line.is_on()
        except BeamLineError:
            return False
        return True

    eventually(answers, within_s=PATIENCE_S, pause_s=0.02, detail=lambda: "the line never answered again")


def test_a_receiver_that_answers_late_latches_the_line_and_sees_off(far, lit, busy):
    far.spoil("late 180")
    spoiled_ns = time.monotonic_ns()
    at_ns, reason, _ = lit.trouble()
    assert at_ns - spoiled_ns <= DETECTION_NS + busy.allowed_ns
    assert reason is FAILED
    _off_edge(far)


def test_a_contact_that_stays_off_latches_the_line_and_is_commanded_off(far, lit, busy):
    far.spoil("stuck off")
    spoiled_ns = time.monotonic_ns()
    at_ns, reason, detail = lit.trouble()
    assert at_ns - spoiled_ns <= DETECTION_NS + busy.allowed_ns
    assert (reason, detail) == (MISMATCH, "the beam line reads back off after the command on")
    _off_edge(far)


def test_a_contact_that_stays_on_latches_the_line(far, lit, busy):
    far.spoil("stuck on")
    lit.off()
    held_ns = time.monotonic_ns()
    lit.line.hold(HoldReason.OUTSIDE_WINDOW)
    at_ns, reason, detail = lit.trouble()
    assert at_ns - held_ns <= DETECTION_NS + busy.allowed_ns
    assert (reason, detail) == (MISMATCH, "the beam line reads back on after the command off")


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_an_engine_that_dies_or_freezes_lets_the_receiver_drop_the_permit_by_its_heartbeat(far, end, busy):
    while True:
        with subprocess.Popen(
            [sys.executable, "-m", "tests.support.beam.engine_program", far.kind, far.where],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
        ) as engine:
            try:
                assert _gets_on(far, lambda engine=engine: engine.poll() is None)
                os.kill(engine.pid, end)
                ended_ns = time.monotonic_ns()
                off_ns, cause = _off_edge(far)
            finally:
                engine.kill()
        if cause == "heartbeat":  # else a busy machine had just made the engine hold by itself: end another
            break
    assert off_ns - ended_ns <= DROP_NS + busy.allowed_ns


def test_a_receiver_that_is_replaced_is_connected_to_again_and_stays_off_until_armed():
    with contextlib.ExitStack() as room:
        with receiver("tcp") as first:
            port = int(first.where)
            renewing = room.enter_context(renewed(opened("tcp", first.where)))
            renewing.turn_on(first)
        renewing.trouble()
        with receiver("tcp", port) as second:
            _await_answers(renewing)
            with pytest.raises(queue.Empty):
                second._lines.get(timeout=0.4)
            renewing.arm()
            renewing.turn_on(second)
            room.close()
            assert second.next_edge()[0] == "off"


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_peer_is_reported_at_opening(kind):
    where = "1" if kind == "tcp" else "/dev/tidegate-none"
    line = WiredBeamLine(wire_to(kind, where), MonotonicClock())
    with pytest.raises(BeamLineError, match=r"does not answer"):
        line.open()
    line.hold(HoldReason.WATCHDOG)
    line.close()


def test_a_line_can_be_closed_and_opened_again_and_leaves_no_thread(far):
    import threading

    before = threading.active_count()
    line = opened(far.kind, far.where)
    line.close()
    open_patiently(line)
    line.close()
    assert threading.active_count() == before
    assert all(first != second for first, second in itertools.pairwise([edge[0] for edge in far.seen]))


@pytest.mark.parametrize("breaks", ["killed", "stuck off"])
def test_of_two_real_lines_both_are_on_or_neither(breaks, busy):
    with receiver("tcp") as first, receiver("lcus") as second, _paired(first, second) as renewing:
        renewing.turn_on(first, second)
        if breaks == "killed":
            first.process.kill()
        else:
            first.spoil("stuck off")
        broken_ns = time.monotonic_ns()
        off_ns, cause = _off_edge(second)
        assert cause == "command"
        assert off_ns - broken_ns <= DETECTION_NS + busy.allowed_ns
        renewing.trouble()
        with pytest.raises(queue.Empty):
            second._lines.get(timeout=0.3)  # permits rain on


def _paired(first, second):
    return renewed(PairedBeamLine(*(opened(far.kind, far.where) for far in (first, second))))
