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

from engine.beam.judge import DETECTION_MS
from engine.beam.paired import PairedBeamLine
from engine.beam.wired import WiredBeamLine
from engine.clock import NS_PER_MS, MonotonicClock
from engine.errors import BeamLineError
from engine.permits import HoldReason
from tests.beam.modbus_server import DROP_NS
from tests.beam.receivers import BUSY_NS, PATIENCE_S, ROOT, Renewing, opened, receiver, wire_to

KINDS = ["tcp", "rtu", "lcus", "lcus-text", "numato"]
DETECTION_NS = int(DETECTION_MS * NS_PER_MS)
FAILED, MISMATCH = HoldReason.BEAM_LINE_FAILED, HoldReason.BEAM_LINE_MISMATCH


@pytest.fixture(params=KINDS)
def far(request):
    with receiver(request.param) as held:
        yield held


@pytest.fixture
def renewing(far):
    held = Renewing(opened(far.kind, far.where))
    held.arm()
    yield held
    held.end()


@pytest.fixture
def lit(far, renewing):
    """Permitted, and seen on by both ends; a busy machine may have made the line give up, then again."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        renewing.on()
        if _gets_on(far, renewing.troubles.empty) and _stays_on(renewing):
            return renewing
        assert time.monotonic() < deadline_s, "the line never came on"
        renewing.off()
        renewing.arm()
        while not renewing.troubles.empty():
            renewing.trouble()


def _gets_on(far, may_still):
    """Whether the receiver goes on while it may still be hoped for."""
    while may_still():
        with contextlib.suppress(queue.Empty):
            if far._lines.get(timeout=0.1)[0] == "on":
                return True
    return False


def _stays_on(renewing):
    try:
        renewing.await_reading(is_on=True)
    except BeamLineError:
        return False
    return renewing.troubles.empty()


def _off_edge(far):
    """The next edge to off: when, and why."""
    edge = far.next_edge()
    assert edge[0] == "off"
    return int(edge[1]), edge[2]


def test_the_receiver_sees_on_while_it_is_permitted_and_off_when_held(far, lit):
    lit.off()
    held_ns = time.monotonic_ns()
    lit.line.hold(HoldReason.OUTSIDE_WINDOW)
    off_ns, cause = _off_edge(far)
    assert cause == "told"
    assert off_ns - held_ns <= DETECTION_NS + BUSY_NS
    lit.await_reading(is_on=False)
    assert lit.troubles.empty()


def test_the_receiver_sees_off_when_nobody_renews_the_lease(far, lit):
    lit.off()
    ended_ns = time.monotonic_ns()
    off_ns, cause = _off_edge(far)
    assert cause == "told"
    assert off_ns - ended_ns <= 200 * NS_PER_MS + BUSY_NS
    lit.await_reading(is_on=False)


def test_a_receiver_that_is_killed_latches_the_line(far, lit):
    far.process.kill()
    killed_ns = time.monotonic_ns()
    at_ns, reason, _ = lit.trouble()
    assert at_ns - killed_ns <= DETECTION_NS + BUSY_NS
    assert reason is FAILED
    with pytest.raises(BeamLineError):
        lit.line.is_on()
    with pytest.raises(BeamLineError):
        lit.line.rearm()


def test_a_receiver_that_freezes_latches_the_line_and_is_never_on_again_by_itself(far, lit):
    far.stop()
    stopped_ns = time.monotonic_ns()
    at_ns, reason, _ = lit.trouble()
    assert at_ns - stopped_ns <= DETECTION_NS + BUSY_NS
    assert reason is FAILED
    far.go_on()
    _off_edge(far)
    _await_answers(lit)
    with pytest.raises(queue.Empty):
        far._lines.get(timeout=0.4)  # permits rain on meanwhile, and the connection is there again
    lit.arm()
    assert far.next_edge()[0] == "on"


def _await_answers(renewing):
    """Wait until the line answers again; it stays latched."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        try:
            renewing.line.is_on()
        except BeamLineError:
            time.sleep(0.02)
        else:
            return
    pytest.fail("the line never answered again")


def test_a_receiver_that_answers_late_latches_the_line_and_sees_off(far, lit):
    far.spoil("late 180")
    spoiled_ns = time.monotonic_ns()
    at_ns, reason, _ = lit.trouble()
    assert at_ns - spoiled_ns <= DETECTION_NS + BUSY_NS
    assert reason is FAILED
    _off_edge(far)


def test_a_contact_that_stays_off_latches_the_line_and_is_told_off(far, lit):
    far.spoil("stuck off")
    spoiled_ns = time.monotonic_ns()
    at_ns, reason, detail = lit.trouble()
    assert at_ns - spoiled_ns <= DETECTION_NS + BUSY_NS
    assert (reason, detail) == (MISMATCH, "the beam line reads back off though told on")
    _off_edge(far)


def test_a_contact_that_stays_on_latches_the_line(far, lit):
    far.spoil("stuck on")
    lit.off()
    held_ns = time.monotonic_ns()
    lit.line.hold(HoldReason.OUTSIDE_WINDOW)
    at_ns, reason, detail = lit.trouble()
    assert at_ns - held_ns <= DETECTION_NS + BUSY_NS
    assert (reason, detail) == (MISMATCH, "the beam line reads back on though told off")


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_an_engine_that_dies_or_freezes_lets_the_receiver_drop_the_permit_by_its_heartbeat(far, end):
    while True:
        with subprocess.Popen(
            [sys.executable, "-m", "tests.beam.engine_process", far.kind, far.where],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
        ) as engine:
            try:
                if not _gets_on(far, lambda engine=engine: engine.poll() is None):
                    continue  # its line answered late at opening
                os.kill(engine.pid, end)
                ended_ns = time.monotonic_ns()
                off_ns, cause = _off_edge(far)
            finally:
                engine.kill()
        if cause == "heartbeat":  # else a busy machine had just made the engine hold by itself: end another
            break
    assert off_ns - ended_ns <= DROP_NS + BUSY_NS


def test_a_receiver_that_is_replaced_is_connected_to_again_and_stays_off_until_armed():
    with receiver("tcp") as first:
        port = int(first.where)
        renewing = Renewing(opened("tcp", first.where))
        renewing.arm()
        renewing.on()
        assert first.next_edge()[0] == "on"
    renewing.trouble()
    with receiver("tcp", port) as second:
        _await_answers(renewing)
        with pytest.raises(queue.Empty):
            second._lines.get(timeout=0.4)
        renewing.arm()
        assert second.next_edge()[0] == "on"
        renewing.end()
        assert second.next_edge()[0] == "off"


@pytest.mark.parametrize("kind", KINDS)
def test_nobody_at_the_other_end_is_told_at_opening(kind):
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
    line.open()
    line.close()
    assert threading.active_count() == before
    assert all(first != second for first, second in itertools.pairwise([edge[0] for edge in far.seen]))


@pytest.mark.parametrize("breaks", ["killed", "stuck off"])
def test_of_two_real_lines_both_are_on_or_neither(breaks):
    with receiver("tcp") as first, receiver("lcus") as second:
        renewing = Renewing(PairedBeamLine(*(opened(far.kind, far.where) for far in (first, second))))
        renewing.arm()
        renewing.on()
        for far in (first, second):
            assert far.next_edge()[0] == "on"
        if breaks == "killed":
            first.process.kill()
        else:
            first.spoil("stuck off")
        broken_ns = time.monotonic_ns()
        off_ns, cause = _off_edge(second)
        assert cause == "told"
        assert off_ns - broken_ns <= DETECTION_NS + BUSY_NS
        renewing.trouble()
        with pytest.raises(queue.Empty):
            second._lines.get(timeout=0.3)  # permits rain on
        renewing.end()
