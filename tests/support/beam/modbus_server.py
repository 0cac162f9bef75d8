"""The receiver of a Modbus line, in a process of its own.

Run: ``python -m tests.support.beam.modbus_server tcp|rtu [PORT]``.

pymodbus's own server. It says ``ready WHERE``, then ``on NS`` and ``off NS CAUSE`` at every edge of its contact, in
monotonic time. It drops the permit when the heartbeat stands still for 200 ms, and wants to see it withdrawn before it
takes one again. A line on standard input spoils it: ``stuck on``, ``stuck off``, ``lag MS``, ``late MS``,
``refuse``, ``keeps`` (the permit, whatever the heartbeat does), ``recloses`` (with the next heartbeat), ``beam on`` and
``beam off`` (whatever the contact does), ``well``. It
ends with its standard input, when its parent is gone.
"""

import asyncio
import os
import sys
import threading
import time
import tty
from contextlib import suppress

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

DROP_NS = 200_000_000
TICK_S = 0.005
UNIT, COIL, EXPECTED, REGISTER, INPUT, BEAM_ON = 7, 3, 4, 11, 5, 6
BAUD = 115_200


class Receiver:
    """The contact, and what moves it."""

    def __init__(self) -> None:
        self.is_on = self.wants_off_first = self.is_expected = False
        self.heartbeat: int | None = None
        self.beaten_ns = time.monotonic_ns()
        self.stuck: bool | None = None
        self.lag_s = self.late_s = 0.0
        self.beam: bool | None = None
        self.asked = INPUT
        self.is_refusing = self.keeps = self.recloses = False

    def spoil(self, words: list[str]) -> None:
        match words:
            case ["stuck", state]:
                self.stuck = state == "on"
            case ["lag", ms]:
                self.lag_s = float(ms) / 1000
            case ["late", ms]:
                self.late_s = float(ms) / 1000
            case ["refuse"]:
                self.is_refusing = True
            case ["keeps"]:
                self.keeps = True
            case ["recloses"]:
                self.recloses = True
            case ["beam", state]:
                self.beam = state == "on"
            case ["well"]:
                self.stuck, self.beam, self.lag_s, self.late_s, self.is_refusing = None, None, 0.0, 0.0, False

    async def access(self, function_code, _start, address, _count, _registers, values):
        """Act on a request as it reaches the data."""
        if self.late_s:
            await asyncio.sleep(self.late_s)
        if values is None:
            self.asked = address
            return None
        if self.is_refusing:
            return ExcCodes.DEVICE_FAILURE
        if function_code == 5 and address == COIL:
            self._permit(is_on=bool(values[0]))
        elif function_code == 5 and address == EXPECTED:
            self._expect(bool(values[0]), "command")
        elif function_code == 6 and address == REGISTER and values[0] != self.heartbeat:
            self.heartbeat, self.beaten_ns = values[0], time.monotonic_ns()
        return None

    def _permit(self, *, is_on: bool) -> None:
        if is_on and self.wants_off_first and not self.recloses:
            return
        self.wants_off_first = False
        if self.lag_s:
            asyncio.get_running_loop().call_later(self.lag_s, self._turn, is_on, "command")
        else:
            self._turn(is_on, "command")

    def _expect(self, is_expected: bool, cause: str) -> None:
        if is_expected is not self.is_expected:
            self.is_expected = is_expected
            say(f"gate {'expected' if is_expected else 'unexpected'} {cause}")

    def _turn(self, is_on: bool, cause: str) -> None:
        if is_on is not self.is_on:
            self.is_on = is_on
            say(f"on {time.monotonic_ns()}" if is_on else f"off {time.monotonic_ns()} {cause}")

    def shown(self) -> bool:
        """What the input says that is asked for: the contact, or the accelerator's beam, which follows it at once."""
        if self.asked == BEAM_ON:
            return self.is_on if self.beam is None else self.beam
        return self.is_on if self.stuck is None else self.stuck

    def answer(self, sending: bool, pdu):
        if sending and pdu.function_code == 2 and not isinstance(pdu, ExceptionResponse):
            pdu.bits = [self.shown()] + [False] * 7
        return pdu

    async def watch_heartbeat(self) -> None:
        parent = os.getppid()
        while os.getppid() == parent:  # ends with its parent
            await asyncio.sleep(TICK_S)
            if self.is_on and not self.keeps and time.monotonic_ns() - self.beaten_ns > DROP_NS:
                self.wants_off_first = True
                self._turn(False, "heartbeat")
            if self.is_expected and time.monotonic_ns() - self.beaten_ns > DROP_NS:
                self._expect(False, "heartbeat")


def say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def device(receiver: Receiver) -> SimDevice:
    blocks = (
        [SimData(COIL, values=False, datatype=DataType.BITS), SimData(EXPECTED, values=False, datatype=DataType.BITS)],
        [SimData(INPUT, values=False, datatype=DataType.BITS), SimData(BEAM_ON, values=False, datatype=DataType.BITS)],
        [SimData(REGISTER, values=0, datatype=DataType.REGISTERS)],
        [SimData(0, values=0, datatype=DataType.REGISTERS)],
    )
    return SimDevice(UNIT, simdata=blocks, action=receiver.access)


def joined_ptys() -> tuple[str, str]:
    """Two serial ports with a cable between them."""
    (master_a, slave_a), (master_b, slave_b) = os.openpty(), os.openpty()
    for end in (slave_a, slave_b):
        tty.setraw(end)
    for source, target in ((master_a, master_b), (master_b, master_a)):
        threading.Thread(target=_copy, args=(source, target), daemon=True).start()
    return os.ttyname(slave_a), os.ttyname(slave_b)


def _copy(source: int, target: int) -> None:
    with suppress(OSError):
        while True:
            os.write(target, os.read(source, 256))


def _obey(receiver: Receiver) -> None:
    line = sys.stdin.readline()
    if not line:
        os._exit(0)
    receiver.spoil(line.split())


async def serve(kind: str, port: int) -> None:
    receiver = Receiver()
    if kind == "rtu":
        where, own = joined_ptys()
        server = ModbusSerialServer(device(receiver), port=own, baudrate=BAUD, trace_pdu=receiver.answer)
    else:
        server = ModbusTcpServer(device(receiver), address=("127.0.0.1", port), trace_pdu=receiver.answer)
    await server.serve_forever(background=True)
    if kind == "tcp":
        where = str(server.transport.sockets[0].getsockname()[1])
    loop = asyncio.get_running_loop()
    loop.add_reader(sys.stdin, _on_command, loop, receiver)
    say(f"ready {where}")
    await receiver.watch_heartbeat()


def _on_command(loop: asyncio.AbstractEventLoop, receiver: Receiver) -> None:
    """Act on a line of standard input; at its end there is nobody who spoils any more, and a receiver goes on."""
    line = sys.stdin.readline()
    if not line:
        loop.remove_reader(sys.stdin)
    receiver.spoil(line.split())


if __name__ == "__main__":
    asyncio.run(serve(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 0))
