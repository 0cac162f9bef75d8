"""A beam line of your own: here a device that takes lines of text over TCP, TIDEGATE_BEAM_PLUG_IN=text:HOST:PORT.

``on 17`` permits the beam with heartbeat 17, ``off 18`` takes the permit away; each is answered by ``closed`` or
``open``, which is the contact. The device opens the contact when no line has come for half a second.
"""

import socket

from tidegate.plug_ins import BeamLineError

CONNECT_S = 0.8


class TextWire:
    """One connection; Tidegate supervises its answers, and reconnects."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise ValueError("the address must be HOST:PORT")
        self._place, self._link = (host, int(port)), None

    @property
    def name(self) -> str:
        """For messages."""
        return f"text line {self._place[0]}:{self._place[1]}"

    def connect(self) -> None:
        """Connect, within a second."""
        self.close()
        self._link = socket.create_connection(self._place, CONNECT_S)

    def exchange(self, *, is_on: bool, heartbeat: int, within_s: float) -> bool:
        """Send the permit and the heartbeat; return whether the contact is closed."""
        if self._link is None:
            raise BeamLineError("not connected")
        self._link.settimeout(within_s)
        self._link.sendall(f"{'on' if is_on else 'off'} {heartbeat}\n".encode())
        answer = self._link.recv(16)
        if answer not in {b"closed\n", b"open\n"}:
            raise BeamLineError(f"unknown answer {answer!r}")
        return answer == b"closed\n"

    def close(self) -> None:
        """Disconnect."""
        if self._link is not None:
            self._link.close()
            self._link = None
