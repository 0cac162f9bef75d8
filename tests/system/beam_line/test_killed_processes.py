"""Real processes, really killed: the line, in a process of its own, is off when the lease ends."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from engine.core.clock import ManualClock, MonotonicClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease
from tests.support.beam.datagram_line import DatagramBeamLine
from tests.support.beam.datagram_receiver import MAX_TRANSIT_NS
from tests.support.beam.receivers import open_patiently
from tests.support.control.real_time_source import PATIENT_LIMITS as LIMITS
from tests.support.repository import ROOT

pytestmark = pytest.mark.waiting

MS = 1_000_000
REPLY_MS = 2_000.0
TRIES = 100
LATEST_END_NS = int(LIMITS.lease_ms * MS) + MAX_TRANSIT_NS + 5 * MS
"""No lease ends later than this after the last frame before the kill: its length, and what a message may take."""


@contextlib.contextmanager
def _process(module: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-m", module, *arguments], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def line(tmp_path: Path) -> Iterator[tuple[Path, subprocess.Popen[str]]]:
    """A beam line that listens, and its socket."""
    path = tmp_path / "line"
    with _process("tests.support.beam.datagram_receiver", str(path)) as receiver:
        assert receiver.stdout is not None
        assert receiver.stdout.readline() == "ready\n"
        yield path, receiver


def _next_edge(receiver: subprocess.Popen[str]) -> list[str]:
    assert receiver.stdout is not None
    return receiver.stdout.readline().split()


def _await_on(receiver: subprocess.Popen[str]) -> None:
    while _next_edge(receiver)[0] != "on":
        continue


def test_an_engine_killed_outright_ends_in_a_line_that_is_off(line):
    path, receiver = line
    while True:
        with _process("tests.support.beam.engine_program", "datagram", str(path)) as engine:
            _await_on(receiver)
            engine.send_signal(signal.SIGKILL)
            killed_ns = time.monotonic_ns()
            engine.wait()
            edge, *times_ns = _next_edge(receiver)
        if edge == "lapsed":  # else a busy machine had just made the engine hold by itself: kill another
            break
    assert int(times_ns[1]) <= killed_ns + LATEST_END_NS


def test_an_engine_that_is_stopped_and_goes_on_later_is_off_in_between_and_pays_a_full_dwell(line):
    path, receiver = line
    with _process("tests.support.beam.engine_program", "datagram", str(path)) as engine:
        while True:
            _await_on(receiver)
            os.kill(engine.pid, signal.SIGSTOP)
            stopped_ns = time.monotonic_ns()
            edge, *times_ns = _next_edge(receiver)
            if edge == "lapsed":
                break
            os.kill(engine.pid, signal.SIGCONT)
        assert int(times_ns[1]) <= stopped_ns + LATEST_END_NS
        continued_ns = time.monotonic_ns()
        os.kill(engine.pid, signal.SIGCONT)
        _read_until_no_longer_on(engine, continued_ns)
        engine.kill()
        engine.wait()
        receiver.kill()
        later = [edge.split() for edge in receiver.stdout.read().splitlines()]
    assert int(times_ns[0]) < continued_ns
    assert all(int(edge[1]) >= continued_ns + LIMITS.dwell_ms * MS for edge in later if edge[0] == "on")


def _read_until_no_longer_on(engine: subprocess.Popen[str], after_ns: int) -> None:
    """Follow the engine's transitions up to the first after it went on."""
    assert engine.stdout is not None
    for reported in engine.stdout:
        _state, _reason, at_ns = reported.split()
        if int(at_ns) > after_ns:
            return
    pytest.fail("the engine reported nothing after it went on")


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[DatagramBeamLine]:
    """This end of the line, open and armed; a busy machine takes its time."""
    beam = DatagramBeamLine(path, MonotonicClock(), reply_ms=REPLY_MS)
    open_patiently(beam)
    try:
        beam.rearm()
        yield beam
    finally:
        beam.close()


def _permit(beam: DatagramBeamLine, sequence: int) -> None:
    now_ns = time.monotonic_ns()
    beam.permit(Lease(granted_ns=now_ns, expires_ns=now_ns + 240 * MS, sequence=sequence))


def _turn_on(beam: DatagramBeamLine) -> None:
    """Permit until the far end reads on: a busy machine may take longer for it than a lease."""
    for sequence in range(1, TRIES):
        _permit(beam, sequence)
        if beam.is_on():
            return
    pytest.fail("the line never read on")


def test_an_engine_that_ends_states_it_to_the_line(line):
    path, receiver = line
    with _opened(path) as beam:
        for _ in range(TRIES):
            _turn_on(beam)
            beam.close()
            if _off_edge(receiver) == "held":  # else the lease of a busy machine had lapsed just before
                return
            open_patiently(beam)
            beam.rearm()
    pytest.fail("the line only ever lapsed")


def _off_edge(receiver: subprocess.Popen[str]) -> str:
    """How the line next goes off."""
    return next(kind for kind in iter(lambda: _next_edge(receiver)[0], "") if kind != "on")


def test_a_watchdog_hold_sent_by_another_thread_latches_the_far_line(line):
    path, _receiver = line
    with _opened(path) as beam:
        _turn_on(beam)
        beam.hold(HoldReason.WATCHDOG)
        with pytest.raises(BeamLineError, match="latched"):
            _permit(beam, TRIES)
        assert not beam.is_on()
        beam._deadman.rearm()  # forget the latch at this end only: the far line keeps its own
        _permit(beam, TRIES + 1)
        assert not beam.is_on()


def test_a_line_that_is_not_there_is_reported_at_opening_and_holding_it_is_harmless(tmp_path):
    beam = DatagramBeamLine(tmp_path / "nobody", ManualClock())
    with pytest.raises(BeamLineError, match="no beam line at nobody"):
        beam.open()
    beam.hold(HoldReason.WATCHDOG)
    with pytest.raises(BeamLineError, match="closed"):
        beam.is_on()
    beam.close()


def test_a_line_that_was_killed_is_a_line_that_does_not_answer(line):
    path, receiver = line
    with _opened(path) as beam:
        receiver.kill()
        receiver.wait()
        with pytest.raises(BeamLineError, match="takes no messages"):
            beam.is_on()
        beam.hold(HoldReason.DISARMED)
