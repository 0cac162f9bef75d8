"""Receivers in processes of their own, as the tests hold them: what they saw, and ways to spoil them."""

import contextlib
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

from engine.beam.heartbeat_drill import DrilledReceiver, OwnInput, SecondInput
from engine.beam.line import BeamLine
from engine.beam.wire.line_supervisor import LineTimes
from engine.beam.wire.modbus import ModbusInput, ModbusWire, rtu_wire, tcp_wire
from engine.beam.wire.register_map import RegisterMap
from engine.beam.wire.serial_relay import RelayWire
from engine.beam.wire.supervised_line import Wire, WiredBeamLine
from engine.core.clock import NS_PER_MS, MonotonicClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease
from tests.support.beam import modbus_server, relay_board
from tests.support.repository import ROOT

BUSY_NS = 150 * NS_PER_MS
"""What a busy test machine may add: processes and threads that are woken late."""

PATIENCE_S = 20.0
SOON_S = 2.0
TIMES = LineTimes(answer_ms=150.0, settle_ms=10.0)
"""As patient as a line may be: a busy machine answers late without being wrong."""

REGISTERS = RegisterMap(
    unit=modbus_server.UNIT,
    permit_coil=modbus_server.COIL,
    heartbeat_register=modbus_server.REGISTER,
    readback_input=modbus_server.INPUT,
)


WITH_BEAM_ON = replace(REGISTERS, beam_on_input=modbus_server.BEAM_ON)


def wire_to(kind: str, where: str, registers: RegisterMap = REGISTERS) -> Wire:
    """The wire that leads to a receiver of this kind."""
    if kind == "tcp":
        return tcp_wire(host="127.0.0.1", port=int(where), registers=registers)
    if kind == "rtu":
        baud = modbus_server.BAUD
        return rtu_wire(device=where, baud=baud, parity="none", stop_bits=1, registers=registers)
    channel, heartbeat = relay_board.CHANNEL, relay_board.HEARTBEAT_CHANNEL
    return RelayWire(device=where, baud=115_200, protocol=kind, channel=channel, heartbeat_channel=heartbeat)


def open_patiently(line: BeamLine) -> None:
    """Open a line; tried again where a busy machine made it answer late."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            line.open()
        except BeamLineError:
            assert time.monotonic() < deadline_s, "the line never opened"
        else:
            return


def opened(kind: str, where: str) -> WiredBeamLine:
    """An open line to a receiver."""
    line = WiredBeamLine(wire_to(kind, where), MonotonicClock(), TIMES)
    open_patiently(line)
    return line


class Lateness:
    """How late a busy machine wakes a thread that only waits, at worst, since it was begun.

    A bound that holds on a machine which wakes threads in time holds, with twice this, on one that does not: once for
    this process, once for the receiver's.
    """

    def __init__(self) -> None:
        self.worst_ns = 0
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._measure, daemon=True)

    def __enter__(self) -> "Lateness":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join(PATIENCE_S)

    @property
    def allowed_ns(self) -> int:
        return BUSY_NS + 2 * self.worst_ns

    def _measure(self) -> None:
        began_ns = time.monotonic_ns()
        while not self._is_over.wait(0.005):
            now_ns = time.monotonic_ns()
            self.worst_ns = max(self.worst_ns, now_ns - began_ns - 5 * NS_PER_MS)
            began_ns = now_ns


class Receiver:
    """A receiver's process; ``seen`` are its edges so far, ``gate`` those of the coil by which a gate is expected."""

    def __init__(self, kind: str, port: int = 0) -> None:
        self.kind = kind
        module = "modbus_server" if kind in {"tcp", "rtu"} else "relay_board"
        self.process = subprocess.Popen(
            [sys.executable, "-m", f"tests.support.beam.{module}", kind, str(port)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.where = self.process.stdout.readline().split()[1]
        self._lines: queue.SimpleQueue[list[str]] = queue.SimpleQueue()
        self.seen: list[list[str]] = []
        self.gate: list[list[str]] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with contextlib.suppress(ValueError):
            for line in self.process.stdout:
                if line.startswith("gate "):
                    self.gate.append(line.split()[1:])
                    continue
                self.seen.append(line.split())
                self._lines.put(line.split())

    def next_edge(self) -> list[str]:
        """The next edge: "on", its time, or "off", its time and its cause; raises queue.Empty if none comes."""
        return self._lines.get(timeout=PATIENCE_S)

    @property
    def is_on(self) -> bool:
        """Whether the newest edge was to on."""
        return bool(self.seen) and self.seen[-1][0] == "on"

    def forget_edges(self) -> None:
        """Let the next edge be one that is still to come."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._lines.get_nowait()

    def spoil(self, words: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{words}\n")
        self.process.stdin.flush()

    def stop(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def go_on(self) -> None:
        self.process.send_signal(signal.SIGCONT)

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join(PATIENCE_S)
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()


@contextlib.contextmanager
def receiver(kind: str, port: int = 0) -> Iterator[Receiver]:
    held = Receiver(kind, port)
    try:
        yield held
    finally:
        held.end()


class WiredInput:
    """A second input that is wired to a board's contact: what the receiver's process reports of it."""

    def __init__(self, far: Receiver) -> None:
        self._far = far

    def open(self) -> None:
        """Nothing is to be opened."""

    def is_closed(self) -> bool:
        return self._far.is_on

    def close(self) -> None:
        """Nothing is to be closed."""


def drilled_part(far: Receiver) -> tuple[WiredBeamLine, DrilledReceiver]:
    """A line to a receiver, and that receiver with another way to see its contact."""
    wire = wire_to(far.kind, far.where)
    line = WiredBeamLine(
        wire, MonotonicClock(), TIMES, look=wire.look if isinstance(wire, ModbusWire) and far.kind == "rtu" else None
    )
    second_input: SecondInput
    if far.kind == "tcp":
        other = wire_to(far.kind, far.where)
        assert isinstance(other, ModbusWire)
        second_input = ModbusInput(other)
    else:
        second_input = OwnInput(line) if far.kind == "rtu" else WiredInput(far)
    return line, DrilledReceiver(name=far.kind, line=line, second_input=second_input)


@contextlib.contextmanager
def renewed(line: BeamLine) -> Iterator["Renewing"]:
    """A line that is open, armed, and permitted as soon as it is asked for."""
    held = Renewing(line)
    try:
        held.arm()
        yield held
    finally:
        held.end()


class Renewing:
    """Permits a line every 25 ms, as an engine does, from a thread; notes what the line found and when."""

    def __init__(self, line: BeamLine) -> None:
        self.line = line
        self.clock = MonotonicClock()
        self.troubles: queue.SimpleQueue[tuple[int, HoldReason, str]] = queue.SimpleQueue()
        line.on_trouble = lambda reason, detail: self.troubles.put((self.clock.now_ns(), reason, detail))
        self._is_wanted, self._is_over = threading.Event(), threading.Event()
        self._sequence = 0
        self._thread = threading.Thread(target=self._renew, daemon=True)
        self._thread.start()

    def on(self) -> None:
        self._is_wanted.set()

    def off(self) -> None:
        self._is_wanted.clear()

    def trouble(self) -> tuple[int, HoldReason, str]:
        return self.troubles.get(timeout=PATIENCE_S)

    def arm(self) -> None:
        """Arm as soon as the line lets itself be armed."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                self.line.rearm()
            except BeamLineError:
                assert time.monotonic() < deadline_s, "the line never let itself be armed"
                self._is_over.wait(0.01)
            else:
                self._sequence = 0
                return

    def await_reading(self, *, is_on: bool) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while self.line.is_on() is not is_on:
            assert time.monotonic() < deadline_s, f"the line never read {'on' if is_on else 'off'}"
            self._is_over.wait(0.005)

    def turn_on(self, *receivers: Receiver) -> None:
        """Permit until every receiver is on and the line reads on, and forget the edges of before.

        A line that gave up on a busy machine is armed again.
        """
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            self.on()
            if self._comes_on(receivers):
                break
            assert time.monotonic() < deadline_s, "the line never came on"
            self.off()
            self.line.hold(HoldReason.OPERATOR_HOLD)
            self._forget()
            self.arm()
        for far in receivers:
            far.forget_edges()

    def _comes_on(self, receivers: tuple[Receiver, ...]) -> bool:
        """Whether it is on everywhere before there is a trouble, and soon."""
        deadline_s = time.monotonic() + SOON_S
        while self.troubles.empty() and time.monotonic() < deadline_s:
            try:
                reads_on = self.line.is_on()
            except BeamLineError:
                return False
            if reads_on and all(far.is_on for far in receivers):
                return self.troubles.empty()
            self._is_over.wait(0.005)
        return False

    def _forget(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self.troubles.get_nowait()

    def end(self) -> None:
        self._is_over.set()
        self._thread.join(PATIENCE_S)
        self.line.close()

    def _renew(self) -> None:
        while not self._is_over.wait(0.025):
            if self._is_wanted.is_set():
                now_ns = self.clock.now_ns()
                self._sequence += 1
                with contextlib.suppress(BeamLineError):
                    lease = Lease(granted_ns=now_ns, expires_ns=now_ns + 200 * NS_PER_MS, sequence=self._sequence)
                    self.line.permit(lease)
