"""A beam line to a receiver in another process, over a UNIX datagram socket.

It shows that a killed engine ends in beam off. The receiver is :mod:`tests.support.beam.datagram_receiver`; this is the
engine's end. A message holds the remaining time of the lease, which the receiver counts by its own clock, and the time
of sending, so that the receiver recognises a message delayed in a stopped process. Clinical lines are wired and have
protocols of their own.
"""

import contextlib
import enum
import os
import select
import socket
import struct
from pathlib import Path
from typing import NamedTuple

from engine.beam.deadman import DeadMan, Grant
from engine.beam.line import TroubleListener, ignore_trouble
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease

MAGIC = b"TGB1"


class MessageKind(enum.IntEnum):
    """Command, query or answer."""

    REARM = 1
    PERMIT = 2
    HOLD = 3
    LATCH = 4
    ASK = 5
    IS_OFF = 6
    IS_ON = 7


class Message(NamedTuple):
    """One datagram; times are the sender's clock, ``left_ns`` is what remains of a lease, ``number`` counts."""

    kind: MessageKind
    number: int = 0
    at_ns: int = 0
    sent_ns: int = 0
    left_ns: int = 0


_LAYOUT = struct.Struct("!4sBQqqq")


def encode(message: Message) -> bytes:
    """Write a message as one datagram."""
    return _LAYOUT.pack(MAGIC, *message)


def decode(packet: bytes) -> Message | None:
    """Read a datagram, or None if it is no message of ours."""
    with contextlib.suppress(struct.error, ValueError):
        magic, kind, *rest = _LAYOUT.unpack(packet)
        if magic == MAGIC:
            return Message(MessageKind(kind), *rest)
    return None


class DatagramBeamLine:
    """Sends permits to the receiver at ``path``; refuses here what the receiver would refuse.

    ``reply_ms`` is how long a read back may take: the engine waits for it on every frame.
    """

    def __init__(self, path: Path, clock: Clock, *, reply_ms: float = 15.0) -> None:
        self._reply_ns = int(reply_ms * NS_PER_MS)
        self._path = path
        self._clock = clock
        self._own_path = path.with_name(f"{path.name}.{os.getpid()}")
        self._deadman = DeadMan()
        self.on_trouble: TroubleListener = ignore_trouble
        self._socket: socket.socket | None = None
        self._asked = 0

    def open(self) -> None:
        """Connect; raise BeamLineError if no one answers, with nothing left open."""
        self._disconnect()
        try:
            self._socket = self._connected()
            self.hold(HoldReason.ENGINE_STOPPED)
            self.is_on()
        except BaseException:
            self._disconnect()
            raise

    def rearm(self) -> None:
        """Accept permits again after a latched hold; the line stays off."""
        self._deadman.rearm()
        self._send(MessageKind.REARM)

    def permit(self, lease: Lease) -> None:
        """Send the lease; raise BeamLineError if it is refused here or cannot be sent."""
        now_ns = self._clock.now_ns()
        grant = Grant(decided_ns=lease.granted_ns, expires_ns=lease.expires_ns, sequence=lease.sequence)
        self._deadman.grant(grant, now_ns=now_ns)
        self._send(
            MessageKind.PERMIT,
            number=lease.sequence,
            at_ns=lease.granted_ns,
            sent_ns=now_ns,
            left_ns=lease.expires_ns - now_ns,
        )

    def hold(self, reason: HoldReason) -> None:
        """Send the hold; where it cannot be sent, nothing renews the lease and it lapses."""
        now_ns = self._clock.now_ns()
        self._deadman.hold(at_ns=now_ns, is_latching=reason.is_fault)
        with contextlib.suppress(BeamLineError):
            self._send(MessageKind.LATCH if reason.is_fault else MessageKind.HOLD, at_ns=now_ns, sent_ns=now_ns)

    def is_on(self) -> bool:
        """Ask the receiver; raise BeamLineError if it does not answer at once."""
        self._asked += 1
        self._send(MessageKind.ASK, number=self._asked)
        deadline_ns = self._clock.now_ns() + self._reply_ns
        while (left_ns := deadline_ns - self._clock.now_ns()) > 0:
            answer = self._receive(left_ns)
            if answer is not None and answer.number == self._asked:
                return answer.kind is MessageKind.IS_ON
        msg = "the beam line does not answer"
        raise BeamLineError(msg)

    @property
    def is_settling(self) -> bool:
        """Never: the receiver switches at once."""
        return False

    def close(self) -> None:
        """Hold, then disconnect."""
        self.hold(HoldReason.ENGINE_STOPPED)
        self._disconnect()

    def _connected(self) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            connection.settimeout(0.0)
            connection.bind(str(self._own_path))
            connection.connect(str(self._path))
        except OSError as error:
            connection.close()
            msg = f"no beam line at {self._path.name}: {error.strerror}"
            raise BeamLineError(msg) from error
        return connection

    def _disconnect(self) -> None:
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()
        self._own_path.unlink(missing_ok=True)

    def _send(self, kind: MessageKind, *, number: int = 0, at_ns: int = 0, sent_ns: int = 0, left_ns: int = 0) -> None:
        connection = self._socket
        if connection is None:
            msg = "the beam line is closed"
            raise BeamLineError(msg)
        try:
            connection.send(encode(Message(kind, number, at_ns, sent_ns, left_ns)))
        except OSError as error:
            msg = f"the beam line takes no messages: {error.strerror}"
            raise BeamLineError(msg) from error

    def _receive(self, timeout_ns: int) -> Message | None:
        connection = self._socket
        if connection is None or not select.select([connection], [], [], timeout_ns / NS_PER_S)[0]:
            return None
        try:
            return decode(connection.recv(_LAYOUT.size))
        except OSError:
            return None
