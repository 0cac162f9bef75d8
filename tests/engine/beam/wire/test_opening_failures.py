"""A line that does not open leaves nothing open: no socket, no port, no thread, no file; and may be opened later."""

import contextlib
import os
import socket
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from engine.beam.line import BeamLine
from engine.beam.paired import PairedBeamLine
from engine.beam.simulated import SimulatedBeamLine
from engine.beam.status.published_line import PublishedBeamLine, StatusPublisher
from engine.beam.wire import supervised_line
from engine.beam.wire.line_supervisor import LineTimes
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import ManualClock, MonotonicClock
from engine.core.errors import BeamLineError
from tests.support.beam.datagram_line import DatagramBeamLine, Message, MessageKind, decode, encode
from tests.support.beam.receivers import wire_to
from tests.support.beam.stepped_line import World

QUICK = LineTimes(answer_ms=20.0, settle_ms=0.0)


def _open_files() -> list[str]:
    """What this process has open, but for the folder that is being read."""
    links = []
    for number in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            links.append(f"{number.name} {number.readlink()}")
    return sorted(link for link in links if not link.endswith("/fd"))


def _threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith("tidegate")}


@contextlib.contextmanager
def _nothing_left_open() -> Iterator[None]:
    files, threads = _open_files(), _threads()
    yield
    assert _open_files() == files
    assert _threads() == threads


@pytest.fixture
def mute_port() -> Iterator[str]:
    """A serial port whose other end never says a word."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.fixture
def mute_server() -> Iterator[str]:
    """A TCP port that takes every connection and never answers."""
    with socket.create_server(("127.0.0.1", 0), backlog=16) as server:
        yield str(server.getsockname()[1])


def _wired(kind: str, request: pytest.FixtureRequest) -> WiredBeamLine:
    where = request.getfixturevalue("mute_server" if kind == "tcp" else "mute_port")
    return WiredBeamLine(wire_to(kind, where), MonotonicClock(), QUICK)


@pytest.mark.parametrize("kind", ["tcp", "rtu", "lcus", "lcus-text", "numato"])
def test_a_wired_line_without_an_answer_leaves_nothing_open(kind, request):
    line = _wired(kind, request)
    with _nothing_left_open(), pytest.raises(BeamLineError, match="does not answer"):
        line.open()


def test_a_wire_that_reads_on_when_it_is_opened_is_closed_again():
    wire = World().wire
    wire.stuck = True
    with pytest.raises(BeamLineError, match="reads back on though nothing was permitted"):
        WiredBeamLine(wire, ManualClock()).open()
    assert (wire.connects, wire.closes) == (1, 1)


@pytest.mark.parametrize("started", [0, 1])
def test_a_line_whose_threads_cannot_be_started_is_closed_again(monkeypatch, started):
    start, count = threading.Thread.start, iter(range(9))

    def scarce(thread: threading.Thread) -> None:
        if thread.name.startswith("tidegate-beam") and next(count) >= started:
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(supervised_line.threading.Thread, "start", scarce)
    wire = World().wire
    line = WiredBeamLine(wire, wire.world.clock)
    with _nothing_left_open(), pytest.raises(RuntimeError, match="new thread"):
        line.open()
    assert wire.closes >= 1
    assert not wire.commands_on
    with pytest.raises(BeamLineError, match="closed"):
        line.is_on()


@pytest.fixture
def mute_line(tmp_path) -> Iterator[Path]:
    """A datagram socket where no one reads."""
    path = tmp_path / "line"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        yield path


def test_a_datagram_line_without_an_answer_leaves_nothing_open_and_no_file(mute_line):
    line = DatagramBeamLine(mute_line, MonotonicClock(), reply_ms=5.0)
    with _nothing_left_open(), pytest.raises(BeamLineError, match="does not answer"):
        line.open()
    assert list(mute_line.parent.iterdir()) == [mute_line]
    with pytest.raises(BeamLineError, match="closed"):
        line.is_on()


@pytest.mark.parametrize("is_folder_there", [True, False])
def test_a_datagram_line_that_is_not_there_leaves_nothing_open_and_no_file(tmp_path, is_folder_there):
    folder = tmp_path if is_folder_there else tmp_path / "gone"
    line = DatagramBeamLine(folder / "line", ManualClock())
    with _nothing_left_open(), pytest.raises(BeamLineError, match="no beam line at line"):
        line.open()
    assert list(tmp_path.iterdir()) == []


def _answer_once(listener: socket.socket) -> None:
    """Be the receiver until a question was answered."""
    while True:
        packet, sender = listener.recvfrom(256)
        asked = decode(packet)
        if asked is not None and asked.kind is MessageKind.ASK:
            listener.sendto(encode(Message(MessageKind.IS_OFF, number=asked.number)), sender)
            return


def test_a_datagram_line_that_did_not_open_opens_when_somebody_answers_and_twice_opened_is_open_once(tmp_path):
    path = tmp_path / "line"
    line = DatagramBeamLine(path, MonotonicClock(), reply_ms=10_000.0)
    with pytest.raises(BeamLineError, match="no beam line"):
        line.open()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        files = len(_open_files())
        for _ in range(2):
            answering = threading.Thread(target=_answer_once, args=(listener,))
            answering.start()
            line.open()
            answering.join()
            assert len(_open_files()) == files + 1
        line.close()
        assert len(_open_files()) == files


class _Deaf(SimulatedBeamLine):
    """A line that does not open."""

    is_closed = False

    def open(self) -> None:
        raise BeamLineError("does not answer")

    def close(self) -> None:
        super().close()
        self.is_closed = True


@pytest.mark.parametrize("deaf", ["first", "second"])
def test_of_two_lines_neither_stays_open_where_one_does_not_open(deaf):
    clock = ManualClock()
    opens = SimulatedBeamLine(clock)
    lines: list[BeamLine] = [_Deaf(clock), opens] if deaf == "first" else [opens, _Deaf(clock)]
    with pytest.raises(BeamLineError, match="does not answer"):
        PairedBeamLine(*lines).open()
    assert not opens._is_open


class _Unstartable(StatusPublisher):
    def start(self) -> None:
        raise RuntimeError("can't start new thread")


class _Kept:
    queue_size = 1

    def send(self, message: bytes) -> None:
        """Take it."""

    def close(self) -> None:
        """Nothing is open."""


def _announcer(kind: Callable[..., StatusPublisher]) -> StatusPublisher:
    return kind(_Kept(), MonotonicClock(), utc_now=lambda: "2026-11-21T03:00:00.000Z")


def test_a_line_without_a_publisher_is_closed_and_no_publisher_keeps_running():
    clock = ManualClock()
    line = SimulatedBeamLine(clock)
    published = PublishedBeamLine(line, [_announcer(StatusPublisher), _announcer(_Unstartable)], clock)
    with _nothing_left_open(), pytest.raises(RuntimeError, match="new thread"):
        published.open()
    assert not line._is_open


def test_a_line_that_does_not_open_is_not_published():
    published = PublishedBeamLine(_Deaf(ManualClock()), [_announcer(StatusPublisher)], ManualClock())
    with _nothing_left_open(), pytest.raises(BeamLineError, match="does not answer"):
        published.open()
