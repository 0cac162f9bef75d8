"""A relay board on a pty, in a process of its own: ``python -m tests.support.beam.relay_board lcus|lcus-text|numato``.

Behind it stands the timer that docs/3-operate/beam.md asks for: it drops the contact when the heartbeat's relay has
not switched for 200 ms, and closes it again only after the permit's relay was off. The program prints ``ready DEVICE``,
then ``on NS`` and ``off NS CAUSE`` at every edge of the contact. A line on standard input damages it, as in
`tests.support.beam.modbus_server`.
"""

import os
import select
import sys
import time
import tty

from tests.support.beam.modbus_server import DROP_NS, say

CHANNEL, HEARTBEAT_CHANNEL = 1, 2


class Board:
    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.relays = {CHANNEL: False, HEARTBEAT_CHANNEL: False}
        self.beaten_ns = time.monotonic_ns()
        self.is_closed = self.wants_off_first = False
        self.stuck: bool | None = None
        self.late_s = 0.0
        self.keeps = self.recloses = False
        self.received = b""

    def spoil(self, words: list[str]) -> None:
        match words:
            case ["stuck", state]:
                self.stuck = state == "on"
            case ["late", ms]:
                self.late_s = float(ms) / 1000
            case ["keeps"]:
                self.keeps = True
            case ["recloses"]:
                self.recloses = True
            case ["well"]:
                self.stuck, self.late_s = None, 0.0

    def receive(self, received: bytes) -> bytes:
        """Take bytes; return what the board says to them."""
        self.received += received
        said = b""
        while (command := self._next_command()) is not None:
            said += self._numato(command) if self.kind == "numato" else self._lcus(command)
        return said

    def _next_command(self) -> bytes | None:
        if self.kind == "numato":
            command, end, rest = self.received.partition(b"\r")
            if not end:
                return None
            self.received = rest
            return command
        length = 1 if self.received[:1] == b"\xff" else 4
        if len(self.received) < length:
            return None
        command, self.received = self.received[:length], self.received[length:]
        return command

    def _lcus(self, command: bytes) -> bytes:
        if command == b"\xff":
            lines = [f"CH{number}: {'ON' if self._shown(number) else 'OFF'} " for number in self.relays]
            return "".join(f"{line}\r\n" for line in lines).encode()
        start, number, code, check = command
        assert start == 0xA0
        assert check == sum(command[:3]) % 256
        if code == 5:
            state = int(self._shown(number))
            return bytes((0xA0, number, state, (0xA0 + number + state) % 256))
        self._switch(number, is_on=code == 1)
        return b""

    def _numato(self, command: bytes) -> bytes:
        _relay, verb, number = command.split()
        if verb == b"read":
            return command + b"\n\r" + (b"on" if self._shown(int(number)) else b"off") + b"\n\r>"
        self._switch(int(number), is_on=verb == b"on")
        return command + b"\n\r>"

    def _shown(self, number: int) -> bool:
        return self.relays[number] if self.stuck is None or number != CHANNEL else self.stuck

    def _switch(self, number: int, *, is_on: bool) -> None:
        if number == HEARTBEAT_CHANNEL and self.relays[number] is not is_on:
            self.beaten_ns = time.monotonic_ns()
        self.relays[number] = is_on
        if number == CHANNEL:
            self.wants_off_first &= is_on
        self.move("command")

    def move(self, cause: str) -> None:
        """Open or close the contact behind the timer."""
        is_late = not self.keeps and time.monotonic_ns() - self.beaten_ns > DROP_NS
        if self.is_closed and is_late:
            self.wants_off_first, cause = not self.recloses, "heartbeat"
        closes = self.relays[CHANNEL] and not is_late and not self.wants_off_first
        if closes is not self.is_closed:
            self.is_closed = closes
            say(f"on {time.monotonic_ns()}" if closes else f"off {time.monotonic_ns()} {cause}")


def serve(kind: str) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    board = Board(kind)
    say(f"ready {os.ttyname(slave)}")
    parent, received = os.getppid(), [master, sys.stdin]
    while os.getppid() == parent:  # ends with its parent
        readable, _, _ = select.select(received, [], [], 0.005)
        if sys.stdin in readable:
            line = sys.stdin.readline()
            board.spoil(line.split())
            received = received if line else [master]
        if master in readable:
            said = board.receive(os.read(master, 256))
            time.sleep(board.late_s)
            os.write(master, said)
        board.move("command")


if __name__ == "__main__":
    serve(sys.argv[1])
