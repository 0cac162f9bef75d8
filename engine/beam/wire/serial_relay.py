"""A relay board on a serial line as a wire; the only importer of pyserial in the engine.

Such boards know neither a lease nor a heartbeat: a relay that is on stays on when this process dies. A second channel
may be switched at every cycle as a heartbeat, for a retriggerable timer between board and accelerator
(docs/3-operate/beam.md). The board reports its own output, not a contact; a modem line wired to the relay's second
contact reads a contact.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import serial

from engine.beam.wire.serial_settings import check_baud
from engine.core.bounds import check_whole_number
from engine.core.errors import BeamLineError, InvalidValueError

ECHO = "no status: the line returns what is sent to it, and no board answers"
Protocol: TypeAlias = Literal["lcus", "lcus-text", "numato"]
Contact: TypeAlias = Literal["none", "cts", "dsr", "cd"]
MAX_ANSWER_BYTES = 512
SHORTEST_S = 0.002
QUIET_S = 0.05
CONNECT_S = 0.5
ASKED_S = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class RelayProtocol:
    """The commands and answers of one kind of board.

    Attributes
    ----------
    channels
        Lowest and highest number of a relay, in the board's own numbering.
    command
        Bytes that switch a relay.
    request
        Bytes that request a relay's state.
    parse
        The state in the bytes received since the request; None while the answer is incomplete.
    answers_only
        Whether the board never sends anything but its answer: any other byte is not from a board.
    """

    channels: tuple[int, int]
    command: Callable[[int, bool], bytes]
    request: Callable[[int], bytes]
    parse: Callable[[bytes, int], bool | None]
    answers_only: bool = False


def _framed(channel: int, code: int) -> bytes:
    """Return A0, channel, code, and the low byte of their sum."""
    return bytes((0xA0, channel, code, (0xA0 + channel + code) & 0xFF))


def _parse_framed(received: bytes, channel: int) -> bool | None:
    if len(received) < 4:
        return None
    for state in (True, False):
        if received == _framed(channel, int(state)):
            return state
    if received.startswith(_framed(channel, 5)):
        raise BeamLineError(ECHO)
    msg = f"no status of relay {channel}: {received[:16].hex(' ')}"
    raise BeamLineError(msg)


def _parse_lines(received: bytes, channel: int) -> bool | None:
    """Find ``CHn: ON`` or ``CHn: OFF`` in lines that have ended."""
    for line in received.upper().replace(b"\r", b"\n").split(b"\n")[:-1]:
        name, colon, state = line.partition(b":")
        if colon and name.strip() == b"CH%d" % channel:
            return _state(state)
    return None


def _parse_prompted(received: bytes, channel: int) -> bool | None:
    """Find ``on`` or ``off`` between the echo of the request and the prompt; the command was echoed before it."""
    _before, request, answer = received.rpartition(b"relay read " + _lettered(channel))
    if not request or not answer.rstrip().endswith(b">"):
        return None
    return _state(answer.rstrip()[:-1])


def _state(word: bytes) -> bool:
    states = {b"ON": True, b"OFF": False}
    if word.strip().upper() not in states:
        msg = f"no state: {word[:16]!r}"
        raise BeamLineError(msg)
    return states[word.strip().upper()]


def _lettered(channel: int) -> bytes:
    """Numato's numbering: 0 to 9, then A to V."""
    return b"%d" % channel if channel < 10 else bytes((ord("A") + channel - 10,))


RELAY_PROTOCOLS: dict[Protocol, RelayProtocol] = {
    "lcus": RelayProtocol(
        channels=(1, 16),
        command=lambda channel, is_on: _framed(channel, int(is_on)),
        request=lambda channel: _framed(channel, 5),
        parse=_parse_framed,
        answers_only=True,
    ),
    "lcus-text": RelayProtocol(
        channels=(1, 16),
        command=lambda channel, is_on: _framed(channel, int(is_on)),
        request=lambda _channel: b"\xff",
        parse=_parse_lines,
    ),
    "numato": RelayProtocol(
        channels=(0, 31),
        command=lambda channel, is_on: b"relay %s %s\r" % (b"on" if is_on else b"off", _lettered(channel)),
        request=lambda channel: b"relay read %s\r" % _lettered(channel),
        parse=_parse_prompted,
    ),
}


def check_channels(
    protocol: Protocol, channel: int, heartbeat_channel: int | None, expected_channel: int | None = None
) -> None:
    """Raise InvalidValueError for a relay that such a board lacks, or one used for two purposes."""
    low, high = RELAY_PROTOCOLS[protocol].channels
    taken: dict[int, str] = {}
    numbers = {"channel": channel, "heartbeat_channel": heartbeat_channel, "expected_channel": expected_channel}
    for name, number in numbers.items():
        if number is None:
            continue
        check_whole_number(name, number, low, high, f"for {protocol}")
        if number in taken:
            raise InvalidValueError(name, number, f"another than {taken[number]} {number}")
        taken[number] = name


class RelayWire:
    """`Wire` to a relay board.

    ``contact`` is a modem line wired to the relay's second contact. The command counts as followed only if board and
    contact both agree with it. ``expected_channel`` is on while the line is in use, off once it is closed: a gate is
    expected.
    """

    def __init__(
        self,
        *,
        device: str,
        baud: int,
        protocol: Protocol,
        channel: int,
        contact: Contact = "none",
        heartbeat_channel: int | None = None,
        expected_channel: int | None = None,
    ) -> None:
        check_channels(protocol, channel, heartbeat_channel, expected_channel)
        check_baud(baud)
        self._protocol = RELAY_PROTOCOLS[protocol]
        self._device, self._baud = device, baud
        self._channel, self._heartbeat_channel, self._contact = channel, heartbeat_channel, contact
        self._expected_channel = expected_channel
        self._port: serial.Serial | None = None

    @property
    def name(self) -> str:
        """The device, for messages."""
        return f"the relay board on {self._device}"

    def connect(self) -> None:
        """Open the port exclusively, and request the state once without a command.

        The echo of a command looks like the expected status; the echo of a request does not.
        """
        self.close()
        port = serial.Serial(self._device, baudrate=self._baud, timeout=QUIET_S, write_timeout=0.5, exclusive=True)
        try:
            until_s = time.monotonic() + CONNECT_S
            while port.read(MAX_ANSWER_BYTES) and time.monotonic() < until_s:
                continue  # an answer to a request from before the connection was lost
            self._request_state(port)
        except BaseException:
            port.close()
            raise
        self._port = port

    def exchange(self, *, is_on: bool, heartbeat: int, within_s: float) -> bool:
        """Command the relay, beat, request the state; return the command only if all that is read agrees with it."""
        port = self._port
        if port is None:
            msg = "the port is closed"
            raise BeamLineError(msg)
        until_s = time.monotonic() + within_s
        port.write_timeout = within_s
        if time.monotonic() >= until_s:  # this process was stopped meanwhile: the command is old
            msg = "the time for an answer is over"
            raise BeamLineError(msg)
        if is_on:
            self._refuse_surplus(port)  # off is commanded in any case
        port.write(self._protocol.command(self._channel, is_on))
        if self._expected_channel is not None:
            port.write(self._protocol.command(self._expected_channel, True))  # noqa: FBT003 - the protocol's callable
        if self._heartbeat_channel is not None:
            port.write(self._protocol.command(self._heartbeat_channel, heartbeat % 2 == 1))
        self._refuse_surplus(port)
        port.reset_input_buffer()
        port.write(self._protocol.request(self._channel))
        reads_on = self._answer(port, until_s)
        self._refuse_surplus(port)
        agrees = reads_on is is_on and (self._contact == "none" or self._is_closed(port) is is_on)
        return is_on if agrees else not is_on

    def look(self, within_s: float) -> bool:  # noqa: ARG002 - a modem line is read at once
        """Read the contact by its modem line and send nothing; raise BeamLineError without one, or when closed."""
        if self._port is None or self._contact == "none":
            msg = "no modem line shows the contact" if self._contact == "none" else "the port is closed"
            raise BeamLineError(msg)
        return self._is_closed(self._port)

    def close(self) -> None:
        """Close the port; no gate is expected any more."""
        port, self._port = self._port, None
        if port is None:
            return
        if self._expected_channel is not None:
            with contextlib.suppress(Exception):
                port.write(self._protocol.command(self._expected_channel, False))  # noqa: FBT003 - as above
        port.close()

    def _request_state(self, port: serial.Serial) -> None:
        """Request the state; where no answer comes, command off and raise BeamLineError."""
        port.write(self._protocol.request(self._channel))
        try:
            self._answer(port, time.monotonic() + ASKED_S)
        except BeamLineError:
            with contextlib.suppress(Exception):
                port.write(self._protocol.command(self._channel, False))  # noqa: FBT003 - the protocol's callable
            raise

    def _refuse_surplus(self, port: serial.Serial) -> None:
        """Raise BeamLineError for bytes that were not requested: an echo, or another program's answer."""
        if self._protocol.answers_only and port.in_waiting:
            msg = f"it sends more than its status: {port.read(MAX_ANSWER_BYTES)[:16].hex(' ')}"
            raise BeamLineError(msg)

    def _answer(self, port: serial.Serial, until_s: float) -> bool:
        received = b""
        while (left_s := until_s - time.monotonic()) > 0.0 and len(received) < MAX_ANSWER_BYTES:
            port.timeout = max(left_s, SHORTEST_S)
            received += port.read(max(port.in_waiting, 1))
            state = self._protocol.parse(received, self._channel)
            if state is not None:
                return state
        if received == self._protocol.request(self._channel):
            raise BeamLineError(ECHO)
        msg = f"no status within the time; received {received[:60]!r}" if received else "no status within the time"
        raise BeamLineError(msg)

    def _is_closed(self, port: serial.Serial) -> bool:
        """Read the modem line that the relay's second contact is wired to."""
        return bool(getattr(port, self._contact))
