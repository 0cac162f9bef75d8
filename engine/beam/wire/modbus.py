"""Modbus as a wire, over TCP or a serial line: a coil for the permit, a register for the heartbeat, an input read back.

The only importer of pymodbus. Its clients make no retries and have the remaining time of the whole exchange: a missing
answer is a matter for :mod:`engine.beam.wire.line_supervisor`, not for retries of a library.
"""

import contextlib
import logging
import time
from typing import TypeAlias

from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from engine.beam.wire.register_map import RegisterMap
from engine.beam.wire.serial_settings import PARITY_LETTERS, Parity, check_baud
from engine.core.errors import BeamLineError

READ_INPUTS, WRITE_COIL, WRITE_REGISTER = 2, 5, 6
"""Function codes: an answer has to have its question's."""
BITS_OF_ONE_INPUT = 8
"""An answer to a question for one input is one byte."""
CONNECT_S = 0.5
LOOK_S = 0.15

Client: TypeAlias = ModbusTcpClient | ModbusSerialClient


class ModbusWire:
    """`Wire` to a Modbus device, through a client of pymodbus."""

    def __init__(self, client: Client, registers: RegisterMap, *, name: str) -> None:
        self._client = client
        self._registers = registers
        self._name = name
        self._beam_on: bool | None = None

    @property
    def beam_on(self) -> bool | None:
        """The accelerator's signal as of the newest exchange, from any thread; None where it is not known."""
        return self._beam_on

    @property
    def name(self) -> str:
        """The device's address, for messages."""
        return self._name

    def connect(self) -> None:
        """Connect; raise BeamLineError if the device does not accept the connection."""
        self.close()
        self._client.comm_params.timeout_connect = CONNECT_S
        if not self._client.connect():
            msg = "cannot connect"
            raise BeamLineError(msg)

    def exchange(self, *, is_on: bool, heartbeat: int, within_s: float) -> bool:
        """Write coils and register and read the inputs: three to five requests within ``within_s``."""
        at = self._registers
        until_s = time.monotonic() + within_s
        try:
            self._allow(until_s)
            self._write_coil(at.permit_coil, "the permit", is_set=is_on)
            self._allow(until_s)
            self._write_heartbeat(heartbeat)
            self._allow(until_s)
            reads_on = self._read_input(at.readback_input, "the read back")
            if at.expected_coil is not None:
                self._allow(until_s)
                self._write_coil(at.expected_coil, "that a gate is expected", is_set=True)
            if at.beam_on_input is not None:
                self._allow(until_s)
                self._beam_on = self._read_input(at.beam_on_input, "the beam-on signal")
        except ModbusException as error:
            raise BeamLineError(str(error)) from error
        return reads_on

    def look(self, within_s: float) -> bool:
        """Read the input within ``within_s`` and write nothing; raise BeamLineError where no answer comes."""
        self._allow(time.monotonic() + within_s)
        try:
            return self._read_input(self._registers.readback_input, "the read back")
        except ModbusException as error:
            raise BeamLineError(str(error)) from error

    def close(self) -> None:
        """Disconnect; no gate is expected any more."""
        self._beam_on = None
        expected_coil = self._registers.expected_coil
        if expected_coil is not None and self._client.connected:
            with contextlib.suppress(ModbusException, BeamLineError):
                self._allow(time.monotonic() + LOOK_S)
                self._write_coil(expected_coil, "that no gate is expected", is_set=False)
        self._client.close()  # type: ignore[no-untyped-call]

    def _write_coil(self, address: int, what: str, *, is_set: bool) -> None:
        answer = self._client.write_coil(address, is_set, device_id=self._registers.unit)
        written = self._good(answer, WRITE_COIL, what)
        if written.address != address or written.bits[:1] != [is_set]:
            raise _different(what)

    def _write_heartbeat(self, value: int) -> None:
        address, what = self._registers.heartbeat_register, "the heartbeat"
        answer = self._client.write_register(address, value, device_id=self._registers.unit)
        written = self._good(answer, WRITE_REGISTER, what)
        if written.address != address or written.registers != [value]:
            raise _different(what)

    def _read_input(self, address: int, what: str) -> bool:
        answer = self._client.read_discrete_inputs(address, count=1, device_id=self._registers.unit)
        bits = self._good(answer, READ_INPUTS, what).bits
        if len(bits) != BITS_OF_ONE_INPUT:
            msg = f"an answer of {len(bits)} bits to a question for one: {what}"
            raise BeamLineError(msg)
        return bits[0]

    def _good(self, answer: ModbusPDU, function: int, what: str) -> ModbusPDU:
        """Return an answer to this very request; raise BeamLineError for a refusal, and for another's answer."""
        if answer.isError():
            code = getattr(answer, "exception_code", "?")
            msg = f"it refuses {what} (Modbus exception {code})"
            raise BeamLineError(msg)
        if answer.function_code != function or answer.dev_id != self._registers.unit:
            msg = (
                f"it answers function {answer.function_code} of device {answer.dev_id}, asked for was function "
                f"{function} of device {self._registers.unit}: {what}"
            )
            raise BeamLineError(msg)
        return answer

    def _allow(self, until_s: float) -> None:
        """Limit the next request to the remaining time.

        A client that lost its connection must not reconnect by itself, and a command decided before this process was
        stopped must not be sent after it continues.
        """
        if not self._client.connected:
            msg = "the connection is gone"
            raise BeamLineError(msg)
        left_s = until_s - time.monotonic()
        if left_s <= 0.0:
            msg = "the time for an answer is over"
            raise BeamLineError(msg)
        self._client.comm_params.timeout_connect = left_s


class ModbusInput:
    """`SecondInput` by a connection of its own to a device, which reads one discrete input and writes nothing."""

    def __init__(self, wire: ModbusWire) -> None:
        self._wire = wire

    def open(self) -> None:
        """Connect; raise BeamLineError if the device does not accept the connection."""
        try:
            self._wire.connect()
        except BeamLineError as error:
            msg = f"the second input, {self._wire.name}: {error}"
            raise BeamLineError(msg) from error

    def is_closed(self) -> bool:
        """Return the input; raise BeamLineError where it does not answer within `LOOK_S`."""
        try:
            return self._wire.look(LOOK_S)
        except BeamLineError as error:
            msg = f"the second input, {self._wire.name}: {error}"
            raise BeamLineError(msg) from error

    def close(self) -> None:
        """Disconnect."""
        self._wire.close()


def tcp_wire(*, host: str, port: int, registers: RegisterMap) -> ModbusWire:
    """Make a wire over TCP."""
    _silence_library()
    client = ModbusTcpClient(host, port=port, timeout=CONNECT_S, retries=0)
    return ModbusWire(client, registers, name=f"the beam line at {host}:{port}")


def rtu_wire(*, device: str, baud: int, parity: Parity, stop_bits: int, registers: RegisterMap) -> ModbusWire:
    """Make a wire over a serial line, RTU framing, eight data bits; raise InvalidValueError for an unknown speed."""
    check_baud(baud)
    _silence_library()
    client = ModbusSerialClient(
        device,
        baudrate=baud,
        bytesize=8,
        parity=PARITY_LETTERS[parity],
        stopbits=stop_bits,
        timeout=CONNECT_S,
        retries=0,
    )
    return ModbusWire(client, registers, name=f"the beam line on {device}")


def _silence_library() -> None:
    """Keep pymodbus from logging each failed attempt, four a second: the line reports the fault itself."""
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


def _different(what: str) -> BeamLineError:
    return BeamLineError(f"it confirms something different than was written: {what}")
