"""The far end of the datagram line as a thread of the test: the receiver's rule, and a note of all that was said."""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from engine.core.clock import Clock
from tests.support.beam.datagram_line import Message, MessageKind, decode
from tests.support.beam.datagram_receiver import BeamReceiver

END = b"the test is over"


class FarEnd:
    """Answers as the receiver would, by the clock it is given; ``answers`` may say otherwise."""

    def __init__(self, path: Path, clock: Clock) -> None:
        self.path, self.clock, self.receiver = path, clock, BeamReceiver()
        self.said: list[Message] = []
        self.has_answered = threading.Event()
        self.answers: Callable[[Message, bytes], list[bytes]] = lambda _asked, answer: [answer]
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def end(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(END, str(self.path))
        self._thread.join()
        self._socket.close()

    def kinds(self) -> list[MessageKind]:
        return [message.kind for message in self.said]

    def _serve(self) -> None:
        while True:
            packet, sender = self._socket.recvfrom(256)
            if packet == END:
                return
            message = decode(packet)
            assert message is not None
            self.said.append(message)
            answer = self.receiver.accept(packet, self.clock.now_ns())
            for said in [] if answer is None else self.answers(message, answer):
                with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):  # the sender has gone
                    self._socket.sendto(said, sender)
                self.has_answered.set()


@contextlib.contextmanager
def far_end(path: Path, clock: Clock) -> Iterator[FarEnd]:
    held = FarEnd(path, clock)
    try:
        yield held
    finally:
        held.end()
