"""The service's side of an engine in a process of its own, with a line in another: held by a test, writer and all."""

import contextlib
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from engine.control.journal.journal import TransitionJournal
from engine.control.outputs import FrameRecord, GateTransition
from engine.core.clock import MonotonicClock
from engine.core.commands import Acknowledge, Arm, Disarm
from engine.core.errors import BeamLineError, CommandRefusedError
from engine.core.gate_state import GateState
from service.core.schemas import sessions
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.process import messages, process_engine, remote_engine
from service.engine_host.process.process_engine import ProcessEngine
from service.engine_host.process.remote_engine import RemoteEngine
from service.engine_host.protocols import SessionPlan
from tests.support import waiting
from tests.support.control.loop_bench import drained
from tests.support.engine_process.real_time_program import LINE
from tests.support.repository import ROOT
from tests.support.service.api_calls import make_calibration

MS = 1_000_000
PACED = "tests.support.engine_process.real_time_program"
SESSION_ID = "0" * 32
PATIENCE_S = 120.0
SILENCE_MS = 400.0
PATIENT = {
    "lease_ms": 200.0,
    "max_frame_age_ms": 200.0,
    "max_gap_ms": 200.0,
    "max_lag_ms": 500.0,
    "max_silence_ms": 2_000.0,
    "watchdog_ms": 400.0,
    "max_service_silence_ms": SILENCE_MS,
    "operator_timeout_s": 0.0,
}
"""Without a page, and for a busy test machine, as those of tests.support.control.real_time_source."""

WINDOW = {"signal": "whole", "lower_mm": -1.0, "upper_mm": 3.0, "hysteresis_mm": 0.0, "dwell_ms": 100.0}


class Line:
    """A receiver in a process of its own, and what it saw: words and times of each edge."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.edges: list[list[str]] = []
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.beam.datagram_receiver", str(path)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with contextlib.suppress(ValueError):
            for line in self.process.stdout:
                self.edges.append(line.split())

    @property
    def is_on(self) -> bool:
        return bool(self.edges) and self.edges[-1][0] == "on"

    def await_off(self, within_s: float = PATIENCE_S) -> list[str]:
        eventually(lambda: not self.is_on, within_s)
        return self.edges[-1]

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join(PATIENCE_S)
        self.process.stdout.close()


@contextlib.contextmanager
def line_at(path: Path) -> Iterator[Line]:
    line = Line(path)
    try:
        yield line
    finally:
        line.end()


def eventually(is_so: Callable[[], object], within_s: float = PATIENCE_S) -> None:
    """Wait with the patience that a real engine's process needs."""
    waiting.eventually(is_so, within_s=within_s, pause_s=0.002, detail=lambda: "it never came to be so")


def make_plan(journal: TransitionJournal | None = None, **changes: object) -> SessionPlan:
    return SessionPlan(
        **{
            "session_id": SESSION_ID,
            "source": sessions.RecordingSource(kind="recording", path="chest.oni"),
            "recording": Path("chest.oni"),
            "calibration": make_calibration(),
            "window": Window.model_validate(WINDOW),
            "journal": journal,
            **changes,
        }
    )


class Bench:
    """An engine's process, opened; a writer that takes what leaves it, as long as it is to."""

    def __init__(self, folder: Path, line: Line, **settings: object) -> None:
        self.line = line
        self.settings = Settings(data_dir=folder / "data", **{**PATIENT, **settings})
        self.journal = TransitionJournal(folder / "one.journal", session_id=SESSION_ID, clock=MonotonicClock())
        self.port = ProcessEngine(self.settings)
        self.samples: list[FrameRecord] = []
        self.transitions: list[GateTransition] = []
        self.writes = threading.Event()
        self.writes.set()
        self.serves = threading.Event()
        """Whether the web server's event loop turns."""
        self.serves.set()
        self._is_over = threading.Event()
        running = self.port.open(make_plan(self.journal))
        assert isinstance(running, RemoteEngine)
        self.engine = running
        self._control = running._child.control.send
        self._writer = threading.Thread(target=self._write, daemon=True)
        self._writer.start()

    @property
    def pid(self) -> int:
        return self.engine.process_id

    def send(self, number: signal.Signals) -> int:
        os.kill(self.pid, number)
        return time.monotonic_ns()

    def turn_on(self) -> None:
        """Arm, as a person would, until the receiver is on; a busy machine may fault on the way."""
        eventually(lambda: self.line.is_on or self._tried())

    def _tried(self) -> bool:
        view = self.engine.status.view
        if view is not None and not view.is_armed:
            with contextlib.suppress(CommandRefusedError, BeamLineError):
                if view.record.gate_state is GateState.FAULT:
                    self.engine.submit(Acknowledge(operator="ann")).result(5.0)
                self.engine.submit(Arm(operator="ann")).result(5.0)
        return self.line.is_on

    def calm(self) -> None:
        """Bring it back to where no one is armed, whatever a test has left."""
        self.send(signal.SIGCONT)
        self.engine._child.control.send = self._control
        self.writes.set()
        self.serves.set()
        self.engine.submit(Disarm(operator="ann")).result(PATIENCE_S)
        eventually(self._is_calm)
        self.transitions.clear()

    def silence(self) -> None:
        """Let nothing of the service come through any more, not even that it lives."""
        self.engine._child.control.send = lambda _message: True

    def _is_calm(self) -> bool:
        view = self.engine.status.view
        if view.record.gate_state is GateState.FAULT:
            with contextlib.suppress(CommandRefusedError):
                self.engine.submit(Acknowledge(operator="ann")).result(PATIENCE_S)
        return view.record.gate_state is GateState.DISARMED and not self.line.is_on

    def _write(self) -> None:
        while not self._is_over.is_set():
            if self.serves.is_set():
                self.port.note_server_turn(time.monotonic_ns())
            if self.writes.wait(0.02):
                self.take()
                self._is_over.wait(0.01)

    def take(self) -> None:
        self.samples += drained(self.engine.samples)
        taken = drained(self.engine.transitions)
        self.transitions += taken
        drained(self.engine.notices)
        self.journal.acknowledge(max((one.number or 0 for one in taken), default=0))

    def end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGCONT)
        self.engine.stop()
        self._is_over.set()
        self._writer.join(PATIENCE_S)
        self.engine.evidence()
        self.port.close()


@contextlib.contextmanager
def bench(folder: Path, line: Line, **settings: object) -> Iterator[Bench]:
    os.environ[LINE] = str(line.path)
    before = messages.MODULE, process_engine.START_S, remote_engine.OPEN_S
    messages.MODULE = PACED
    process_engine.START_S = remote_engine.OPEN_S = PATIENCE_S
    try:
        held = Bench(folder, line, **settings)
        try:
            yield held
        finally:
            held.end()
    finally:
        messages.MODULE, process_engine.START_S, remote_engine.OPEN_S = before


def is_there(pid: int) -> bool:
    """Whether a process lives; one that waits to be buried is there, too."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def next_of(source: "queue.Queue", within_s: float = PATIENCE_S):
    return source.get(timeout=within_s)
