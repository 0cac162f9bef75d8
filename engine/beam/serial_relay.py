"""A relay board on a serial line as a wire; the only importer of pyserial here.

Such boards know neither a lease nor a heartbeat: one that is told on stays on when this process dies. A second channel
may be switched at every cycle as a heartbeat, for a retriggerable timer between board and accelerator (docs/beam.md).
What the board says of itself is no contact of its own; a modem line wired to the relay's second contact is one.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import serial

from engine.beam.serial_line import check_baud
from engine.errors import BeamLineError, InvalidValueError

ECHO = "no status: it sends back what it is sent, and no board answers"
Protocol: TypeAlias = Literal["lcus", "lcus-text", "numato"]
Contact: TypeAlias = Literal["none", "cts", "dsr", "cd"]
MAX_ANSWER_BYTES = 512
SHORTEST_S = 0.002
QUIET_S = 0.05
CONNECT_S = 0.5
ASKED_S = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class RelayProtocol:
    """How a kind of board is spoken to.

    Attributes
    ----------
    channels
        Lowest and highest number of a relay, as the board counts.
    order
        What to send to switch a relay.
    question
        What to send to ask for a relay's state.
    parse
        The state in what the board has sent since it was asked; None while the answer is not whole.
    says_no_more
        Whether the board sends its answer and nothing else, ever: what comes besides is no board's.
    """

    channels: tuple[int, int]
    order: Callable[[int, bool], bytes]
    question: Callable[[int], bytes]
    parse: Callable[[bytes, int], bool | None]
    says_no_more: bool = False


def _framed(channel: int, code: int) -> bytes:
    """A0, channel, code, and the low byte of their sum."""
    return bytes((0xA0, channel, code, (0xA0 + channel + code) & 0xFF))


def _parse_framed(said: bytes, channel: int) -> bool | None:
    if len(said) < 4:
        return None
    for state in (True, False):
        if said == _framed(channel, int(state)):
            return state
    if said.startswith(_framed(channel, 5)):
        raise BeamLineError(ECHO)
    msg = f"no status of relay {channel}: {said[:16].hex(' ')}"
    raise BeamLineError(msg)


def _parse_lines(said: bytes, channel: int) -> bool | None:
    """Find ``CHn: ON`` or ``CHn: OFF`` in lines that have ended."""
    for line in said.upper().replace(b"\r", b"\n").split(b"\n")[:-1]:
        name, colon, state = line.partition(b":")
        if colon and name.strip() == b"CH%d" % channel:
            return _state(state)
    return None


def _parse_prompted(said: bytes, channel: int) -> bool | None:
    """Find ``on`` or ``off`` between the echo of the question and the prompt; the order was echoed before it."""
    _before, asked, answer = said.rpartition(b"relay read " + _lettered(channel))
    if not asked or not answer.rstrip().endswith(b">"):
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
        order=lambda channel, is_on: _framed(channel, int(is_on)),
        question=lambda channel: _framed(channel, 5),
        parse=_parse_framed,
        says_no_more=True,
    ),
    "lcus-text": RelayProtocol(
        channels=(1, 16),
        order=lambda channel, is_on: _framed(channel, int(is_on)),
        question=lambda _channel: b"\xff",
        parse=_parse_lines,
    ),
    "numato": RelayProtocol(
        channels=(0, 31),
        order=lambda channel, is_on: b"relay %s %s\r" % (b"on" if is_on else b"off", _lettered(channel)),
        question=lambda channel: b"relay read %s\r" % _lettered(channel),
        parse=_parse_prompted,
    ),
}


def check_channels(protocol: Protocol, channel: int, heartbeat_channel: int | None) -> None:
    """Refuse relays that no such board has, or one for two purposes; raise InvalidValueError."""
    low, high = RELAY_PROTOCOLS[protocol].channels
    for name, number in (("channel", channel), ("heartbeat_channel", heartbeat_channel)):
        if number is not None and not low <= number <= high:
            raise InvalidValueError(name, number, f"a whole number from {low} to {high} for {protocol}")
    if heartbeat_channel == channel:
        raise InvalidValueError("heartbeat_channel", heartbeat_channel, f"another than channel {channel}")


class RelayWire:
    """Exchanges with a board; `Wire`.

    ``contact`` is a modem line wired to the relay's second contact. Board and contact must both say what was told: one
    that contradicts wins, whichever it is.
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
    ) -> None:
        check_channels(protocol, channel, heartbeat_channel)
        check_baud(baud)
        self._protocol = RELAY_PROTOCOLS[protocol]
        self._device, self._baud = device, baud
        self._channel, self._heartbeat_channel, self._contact = channel, heartbeat_channel, contact
        self._port: serial.Serial | None = None

    @property
    def name(self) -> str:
        """The device, for a person."""
        return f"the relay board on {self._device}"

    def connect(self) -> None:
        """Open the port, for us alone, and ask once without an order.

        An order that comes back as an echo looks like the status that was hoped for; a question that does is none.
        """
        self.close()
        port = serial.Serial(self._device, baudrate=self._baud, timeout=QUIET_S, write_timeout=0.5, exclusive=True)
        try:
            until_s = time.monotonic() + CONNECT_S
            while port.read(MAX_ANSWER_BYTES) and time.monotonic() < until_s:
                continue  # an answer to what was asked before the connection was lost
            self._ask(port)
        except BaseException:
            port.close()
            raise
        self._port = port

    def exchange(self, *, is_on: bool, heartbeat: int, within_s: float) -> bool:
        """Order, beat, ask; return what was told only if everything that can be read agrees with it."""
        port = self._port
        if port is None:
            msg = "the port is closed"
            raise BeamLineError(msg)
        until_s = time.monotonic() + within_s
        port.write_timeout = within_s
        if time.monotonic() >= until_s:  # this process was stopped, and goes on with what was decided before
            msg = "the time for an answer is over"
            raise BeamLineError(msg)
        if is_on:
            self._refuse_surplus(port)  # an off is told in any case
        port.write(self._protocol.order(self._channel, is_on))
        if self._heartbeat_channel is not None:
            port.write(self._protocol.order(self._heartbeat_channel, heartbeat % 2 == 1))
        self._refuse_surplus(port)
        port.reset_input_buffer()
        port.write(self._protocol.question(self._channel))
        says_on = self._answer(port, until_s)
        self._refuse_surplus(port)
        agrees = says_on is is_on and (self._contact == "none" or self._is_closed(port) is is_on)
        return is_on if agrees else not is_on

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _ask(self, port: serial.Serial) -> None:
        """Ask for the state, whatever it is; where nobody tells it, order off all the same and raise BeamLineError."""
        port.write(self._protocol.question(self._channel))
        try:
            self._answer(port, time.monotonic() + ASKED_S)
        except BeamLineError:
            with contextlib.suppress(Exception):
                port.write(self._protocol.order(self._channel, False))  # noqa: FBT003 - the protocol's callable
            raise

    def _refuse_surplus(self, port: serial.Serial) -> None:
        """Raise BeamLineError where something was sent that nobody asked for: an echo, or another program's answer."""
        if self._protocol.says_no_more and port.in_waiting:
            msg = f"it says more than its status: {port.read(MAX_ANSWER_BYTES)[:16].hex(' ')}"
            raise BeamLineError(msg)

    def _answer(self, port: serial.Serial, until_s: float) -> bool:
        said = b""
        while (left_s := until_s - time.monotonic()) > 0.0 and len(said) < MAX_ANSWER_BYTES:
            port.timeout = max(left_s, SHORTEST_S)
            said += port.read(max(port.in_waiting, 1))
            state = self._protocol.parse(said, self._channel)
            if state is not None:
                return state
        if said == self._protocol.question(self._channel):
            raise BeamLineError(ECHO)
        msg = f"no status within the time; it said {said[:60]!r}" if said else "no status within the time"
        raise BeamLineError(msg)

    def _is_closed(self, port: serial.Serial) -> bool:
        """Read the modem line that the relay's second contact is wired to."""
        return bool(getattr(port, self._contact))
