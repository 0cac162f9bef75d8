"""The engine's end of the datagram line: what it says, byte by byte, and which answers it believes."""

import socket

import pytest

from engine.core.clock import ManualClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease
from tests.support.beam import datagram_line as datagram, datagram_receiver as receiving
from tests.support.beam.datagram_line import DatagramBeamLine, Message, MessageKind, decode, encode
from tests.support.beam.datagram_peer import far_end
from tests.support.beam.datagram_receiver import IDLE_S, BeamReceiver, serve
from tests.support.beam.stepped_line import MS

K = MessageKind
START_NS = 1_000 * MS


@pytest.fixture
def clock():
    return ManualClock(START_NS)


@pytest.fixture
def far(tmp_path, clock):
    with far_end(tmp_path / "line", clock) as held:
        yield held


@pytest.fixture
def line(far, clock):
    held = DatagramBeamLine(far.path, clock)
    held.open()
    yield held
    held.close()


def permit(line, clock, sequence=1, *, decided_ns=None, length_ns=80 * MS):
    granted_ns = clock.now_ns() if decided_ns is None else decided_ns
    line.permit(Lease(granted_ns=granted_ns, expires_ns=clock.now_ns() + length_ns, sequence=sequence))


def test_each_order_is_one_message_that_states_when_it_was_decided_when_it_was_sent_and_what_is_left(line, far, clock):
    line.rearm()
    clock.advance_ns(10 * MS)
    permit(line, clock, 5, decided_ns=clock.now_ns() - 2 * MS, length_ns=70 * MS)
    assert line.is_on()
    line.hold(HoldReason.OUTSIDE_WINDOW)
    assert not line.is_on()
    line.hold(HoldReason.WATCHDOG)
    assert not line.is_on()
    later_ns = START_NS + 10 * MS
    assert far.said == [
        Message(K.LATCH, 0, START_NS, START_NS, 0),
        Message(K.ASK, 1, 0, 0, 0),
        Message(K.REARM, 0, 0, 0, 0),
        Message(K.PERMIT, 5, later_ns - 2 * MS, later_ns, 70 * MS),
        Message(K.ASK, 2, 0, 0, 0),
        Message(K.HOLD, 0, later_ns, later_ns, 0),
        Message(K.ASK, 3, 0, 0, 0),
        Message(K.LATCH, 0, later_ns, later_ns, 0),
        Message(K.ASK, 4, 0, 0, 0),
    ]


def test_closing_latches_the_far_end_and_leaves_nothing_behind(far, clock):
    line = DatagramBeamLine(far.path, clock)
    line.open()
    line.rearm()
    clock.advance_ns(MS)
    permit(line, clock)
    assert line.is_on()
    line.close()
    line.hold(HoldReason.OUTSIDE_WINDOW)  # no one is reported any more, and nothing is raised
    assert list(far.path.parent.iterdir()) == [far.path]
    with pytest.raises(BeamLineError, match="the beam line is closed"):
        line.is_on()


def test_an_answer_to_an_earlier_question_or_of_noise_is_passed_over(line, far):
    old = encode(Message(K.IS_ON, number=1))
    far.answers = lambda _asked, answer: [old, b"noise", answer]
    assert not line.is_on()
    assert not line.is_on()


@pytest.mark.parametrize("left_ns", [1, 0])
def test_an_answer_counts_until_the_time_for_it_is_over(far, clock, left_ns):
    line = DatagramBeamLine(far.path, clock, reply_ms=15.0)
    line.open()
    far.has_answered.clear()
    asked_ns = clock.now_ns()

    class Until:
        """Passes the whole time for an answer, but for what is left, while the answer comes."""

        calls = 0

        def now_ns(self):
            self.calls += 1
            if self.calls == 1:
                return asked_ns
            assert far.has_answered.wait(20.0)
            return asked_ns + 15 * MS - (left_ns if self.calls == 2 else 0)

    line._clock = Until()
    if left_ns:
        assert line.is_on() is False
    else:
        with pytest.raises(BeamLineError, match="the beam line does not answer"):
            line.is_on()
    line._clock = clock
    line.close()


def test_a_full_peer_is_reported_at_once_without_waiting(tmp_path, clock):
    path = tmp_path / "full"
    with far_end(path, clock) as far:
        line = DatagramBeamLine(path, clock)
        line.open()
        assert line._socket.gettimeout() == 0.0
        far.answers = lambda _asked, _answer: []
    with pytest.raises(BeamLineError, match="takes no messages: "):
        line.rearm()
    line.hold(HoldReason.OUTSIDE_WINDOW)
    line.close()


def test_a_permit_that_is_refused_here_is_not_sent(line, far, clock):
    line.rearm()
    clock.advance_ns(MS)
    permit(line, clock, 2)
    with pytest.raises(BeamLineError, match="came after"):
        permit(line, clock, 2)
    assert line.is_on()
    assert far.kinds().count(K.PERMIT) == 1


@pytest.mark.parametrize("packet", [b"", b"short", b"x" * 37, b"TGB1" + b"\xff" * 33, encode(Message(K.ASK)) + b"x"])
def test_what_is_no_message_is_none(packet):
    assert decode(packet) is None


def test_an_engine_s_end_waits_for_no_time():
    assert not DatagramBeamLine.__new__(DatagramBeamLine).is_settling


# The receiver's own loop, in this process.


class _Over(BaseException):
    """The test is over: the receiver serves until it is killed."""


class Steps:
    """A clock that tells one time after another, and ends the loop behind the last."""

    def __init__(self, *times_ms):
        self.times_ms = list(times_ms)

    def now_ns(self):
        if not self.times_ms:
            raise _Over
        return self.times_ms.pop(0) * MS


class Scripted:
    """A socket that hands out packets, or times out where there is None; notes waits and answers."""

    def __init__(self, *packets):
        self.packets, self.waits, self.answers, self.bound = list(packets), [], [], None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        """Nothing is open."""

    def bind(self, path):
        self.bound = path

    def settimeout(self, seconds):
        self.waits.append(seconds)

    def recvfrom(self, _size):
        packet = self.packets.pop(0)
        if packet is None:
            raise TimeoutError
        return packet

    def sendto(self, answer, flags, sender):
        self.answers.append((decode(answer), flags, sender))


def served(monkeypatch, tmp_path, packets, clock):
    scripted = Scripted(*packets)
    kinds = []
    monkeypatch.setattr(receiving.socket, "socket", lambda *kind: (kinds.append(kind), scripted)[1])
    with pytest.raises(_Over):
        serve(tmp_path / "line", clock)
    assert kinds == [(socket.AF_UNIX, socket.SOCK_DGRAM)]
    assert scripted.bound == str(tmp_path / "line")
    return scripted


def permitted(number, *, at_ms, left_ms=80):
    return encode(Message(K.PERMIT, number, at_ms * MS, at_ms * MS, left_ms * MS))


def test_the_receiver_states_when_it_goes_on_when_it_is_held_and_when_and_at_what_end_a_lease_lapsed(
    monkeypatch, tmp_path, capsys
):
    packets = [
        (encode(Message(K.REARM)), None),
        (permitted(1, at_ms=102), None),
        (encode(Message(K.HOLD, 0, 103 * MS, 103 * MS)), None),
        (permitted(2, at_ms=110), None),
        None,
    ]
    # Each turn looks at the clock for its wait, at the packet, and for the edge behind it.
    clock = Steps(100, 101, 101, 102, 102, 102, 103, 104, 104, 110, 110, 110, 111, 195)
    scripted = served(monkeypatch, tmp_path, packets, clock)
    assert capsys.readouterr().out.splitlines() == [
        "ready",
        f"on {102 * MS}",
        f"held {104 * MS}",
        f"on {110 * MS}",
        f"lapsed {195 * MS} {190 * MS}",
    ]
    assert scripted.waits == [IDLE_S, IDLE_S, pytest.approx(0.079), IDLE_S, pytest.approx(0.079)]


def test_the_receiver_answers_who_asks_and_has_an_address_and_never_waits_for_them(monkeypatch, tmp_path):
    asked = encode(Message(K.ASK, 7))
    packets = [
        (encode(Message(K.REARM)), "/a"),
        (asked, "/a"),
        (permitted(1, at_ms=102), "/a"),
        (asked, "/a"),
        (asked, None),
    ]
    scripted = served(monkeypatch, tmp_path, packets, Steps(*[102] * 15))
    assert scripted.answers == [
        (Message(K.IS_OFF, 7), socket.MSG_DONTWAIT, "/a"),
        (Message(K.IS_ON, 7), socket.MSG_DONTWAIT, "/a"),
    ]


def test_a_question_is_never_late_and_changes_nothing_of_what_is():
    receiver = BeamReceiver()
    receiver.accept(encode(Message(K.REARM)), 500 * MS)
    receiver.accept(permitted(1, at_ms=0), 500 * MS)
    answer = receiver.accept(encode(Message(K.ASK, 3, 0, -(10**12), 0)), 510 * MS)
    assert decode(answer) == Message(K.IS_ON, 3)
    receiver.accept(permitted(2, at_ms=30), 530 * MS)
    assert receiver.is_on(600 * MS)


@pytest.mark.parametrize(("now_ms", "wait_s"), [(500, 0.08), (579, 0.001), (580 - 1e-6, 1e-9), (580, IDLE_S)])
def test_the_receiver_sleeps_no_longer_than_its_lease(now_ms, wait_s):
    receiver = BeamReceiver()
    assert receiver.wait_s(0) == IDLE_S
    receiver.accept(encode(Message(K.REARM)), 0)
    receiver.accept(permitted(1, at_ms=0), 500 * MS)
    assert receiver.wait_s(round(now_ms * MS)) == pytest.approx(wait_s, rel=1e-6, abs=0.0)


def test_a_receiver_is_listened_to_for_what_is_left_of_its_time_and_never_for_ever(line, clock, monkeypatch):
    waited_s = []

    def nothing_comes(_reading, _writing, _failing, *timeout_s):
        waited_s.append(timeout_s)
        clock.advance_ns(line._reply_ns * 3 // 4)
        return [], [], []

    monkeypatch.setattr(datagram.select, "select", nothing_comes)
    with pytest.raises(BeamLineError, match="does not answer"):
        line.is_on()
    reply_s = line._reply_ns / 1e9
    assert waited_s == [(reply_s,), (pytest.approx(reply_s / 4),)]
    monkeypatch.undo()
