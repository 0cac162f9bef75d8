"""The receiver of :class:`tests.support.beam.datagram_line.DatagramBeamLine`, in a process of its own.

``python -m tests.support.beam.datagram_receiver SOCKET`` prints ``ready`` and then one line at every edge, with its own
monotonic time: ``on NS``, ``held NS`` or, when a lease was not renewed, ``lapsed NS END_OF_LEASE_NS``. Without a fresh
permit it is off when the lease ends.
"""

import contextlib
import socket
import sys
from pathlib import Path

from engine.beam.deadman import DeadMan, Grant
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock, MonotonicClock
from engine.core.errors import BeamLineError
from tests.support.beam.datagram_line import Message, MessageKind, decode, encode

MAX_TRANSIT_NS = 20 * NS_PER_MS
"""A permit is refused when its time on the way exceeds that of the fastest message by more than this."""

IDLE_S = 1.0


class BeamReceiver:
    """State and answers of the line, without a socket."""

    def __init__(self) -> None:
        self._deadman = DeadMan()
        self._least_transit_ns: int | None = None

    def accept(self, packet: bytes, now_ns: int) -> bytes | None:
        """Act on a datagram; return the answer to send, if it asks for one."""
        message = decode(packet)
        if message is None:
            return None
        is_late = self._is_late(message, now_ns)
        match message.kind:
            case MessageKind.REARM:
                self._deadman.rearm()
            case MessageKind.PERMIT if not is_late:
                self._permit(message, now_ns)
            case MessageKind.HOLD | MessageKind.LATCH:
                self._deadman.hold(at_ns=message.at_ns, is_latching=message.kind is MessageKind.LATCH)
            case MessageKind.ASK:
                kind = MessageKind.IS_ON if self.is_on(now_ns) else MessageKind.IS_OFF
                return encode(Message(kind, number=message.number))
        return None

    def is_on(self, now_ns: int) -> bool:
        """Whether the line is on."""
        return self._deadman.is_on(now_ns)

    def wait_s(self, now_ns: int) -> float:
        """How long nothing can change without a message."""
        expires_ns = self._deadman.expires_ns
        if expires_ns is None or not self.is_on(now_ns):
            return IDLE_S
        return max(expires_ns - now_ns, 1) / NS_PER_S

    def off_line(self, now_ns: int) -> str:
        """Word the edge to off: held, or lapsed and when."""
        expires_ns = self._deadman.expires_ns
        return f"held {now_ns}" if expires_ns is None else f"lapsed {now_ns} {expires_ns}"

    def _is_late(self, message: Message, now_ns: int) -> bool:
        """Compare its time on the way with the promptest message's; holds count too, and come before any permit."""
        if message.kind not in {MessageKind.PERMIT, MessageKind.HOLD, MessageKind.LATCH}:
            return False
        transit_ns = now_ns - message.sent_ns
        least_ns = transit_ns if self._least_transit_ns is None else min(transit_ns, self._least_transit_ns)
        self._least_transit_ns = least_ns
        return transit_ns - least_ns > MAX_TRANSIT_NS

    def _permit(self, message: Message, now_ns: int) -> None:
        grant = Grant(decided_ns=message.at_ns, expires_ns=now_ns + message.left_ns, sequence=message.number)
        with contextlib.suppress(BeamLineError):  # refused is off: the asker reads it back
            self._deadman.grant(grant, now_ns=now_ns)


def serve(path: Path, clock: Clock) -> None:
    """Be the line at ``path`` until killed."""
    receiver, was_on = BeamReceiver(), False
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as connection:
        connection.bind(str(path))
        _say("ready")
        while True:
            connection.settimeout(receiver.wait_s(clock.now_ns()))
            with contextlib.suppress(OSError):
                packet, sender = connection.recvfrom(256)
                answer = receiver.accept(packet, clock.now_ns())
                if answer is not None and sender:
                    connection.sendto(answer, socket.MSG_DONTWAIT, sender)
            now_ns = clock.now_ns()
            if receiver.is_on(now_ns) is not was_on:
                was_on = not was_on
                _say(f"on {now_ns}" if was_on else receiver.off_line(now_ns))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), MonotonicClock())
