"""The beam line in a process of its own, what it wrote of itself, and a way to it whose answers can be spoiled."""

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from engine.core.errors import BeamLineError
from tests.support.beam.datagram_line import DatagramBeamLine, Message, MessageKind
from tests.support.repository import ROOT

LONGEST_WAIT_S = 20.0


@dataclass(frozen=True, slots=True)
class Edge:
    """One line of the receiver's log; times are the host's monotonic clock, which all processes share [ns]."""

    kind: str
    at_ns: int

    @property
    def is_on(self) -> bool:
        return self.kind == "on"


class FarLine:
    """The receiver's process and its log, read as it is written."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        self._edges: list[Edge] = []
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)

    @property
    def edges(self) -> list[Edge]:
        with self._changed:
            return list(self._edges)

    @property
    def is_on(self) -> bool:
        edges = self.edges
        return bool(edges) and edges[-1].is_on

    def await_edge(self, *, is_on: bool, after_ns: int, within_s: float = LONGEST_WAIT_S) -> Edge | None:
        """The first such edge after a time; None when there is none in time."""

        def found() -> Edge | None:
            return next((edge for edge in self._edges if edge.is_on is is_on and edge.at_ns >= after_ns), None)

        with self._changed:
            self._changed.wait_for(lambda: found() is not None, timeout=within_s)
            return found()

    def start(self) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"
        self._reader.start()

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for written in self._process.stdout:
            kind, at_ns, *_ = written.split()
            with self._changed:
                self._edges.append(Edge(kind, int(at_ns)))
                self._changed.notify_all()


@contextlib.contextmanager
def far_line(path: Path) -> Iterator[FarLine]:
    """Run the receiver at ``path`` until the end of the block."""
    command = [sys.executable, "-m", "tests.support.beam.datagram_receiver", str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        line = FarLine(process)
        try:
            line.start()
            yield line
        finally:
            line.stop()


class SpoiledAnswers(DatagramBeamLine):
    """The engine's end of the line, with answers that get lost or lie on the way back; orders arrive all the same.

    Opened until it answers: a busy machine takes its time to run a new process.
    """

    is_deaf = False
    is_lied_to = False

    def open(self) -> None:
        until_s = time.monotonic() + LONGEST_WAIT_S
        while True:
            try:
                super().open()
            except BeamLineError:
                if time.monotonic() > until_s:
                    raise
            else:
                return

    def _receive(self, timeout_ns: int) -> Message | None:
        answer = super()._receive(timeout_ns)
        if answer is None or self.is_deaf:
            return None
        if not self.is_lied_to:
            return answer
        return answer._replace(kind=MessageKind.IS_OFF if answer.kind is MessageKind.IS_ON else MessageKind.IS_ON)
