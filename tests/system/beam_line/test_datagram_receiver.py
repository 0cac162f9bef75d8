"""The far end of the datagram line, without its process: what it believes of a message, and when it is off."""

import pytest

from tests.support.beam.datagram_line import Message, MessageKind, decode, encode
from tests.support.beam.datagram_receiver import MAX_TRANSIT_NS, BeamReceiver

MS = 1_000_000


def _permit_packet(number: int, *, sent_ns: int, left_ns: int = 80 * MS) -> bytes:
    return encode(Message(MessageKind.PERMIT, number=number, at_ns=sent_ns, sent_ns=sent_ns, left_ns=left_ns))


def _armed_receiver() -> BeamReceiver:
    receiver = BeamReceiver()
    receiver.accept(encode(Message(MessageKind.REARM)), 0)
    return receiver


def test_the_receiver_counts_what_is_left_of_a_lease_on_its_own_clock():
    receiver = _armed_receiver()
    receiver.accept(_permit_packet(1, sent_ns=10**15), 500 * MS)
    assert receiver.is_on(580 * MS - 1)
    assert not receiver.is_on(580 * MS)


@pytest.mark.parametrize(("delay_ns", "is_on"), [(MAX_TRANSIT_NS, True), (MAX_TRANSIT_NS + 1, False)])
def test_a_permit_that_lay_in_a_stopped_process_is_refused(delay_ns, is_on):
    receiver = _armed_receiver()
    receiver.accept(_permit_packet(1, sent_ns=0), 500 * MS)
    receiver.accept(_permit_packet(2, sent_ns=33 * MS), 533 * MS)
    receiver.accept(encode(Message(MessageKind.HOLD, at_ns=34 * MS, sent_ns=34 * MS)), 534 * MS)
    late_ns = 10_000 * MS
    receiver.accept(_permit_packet(3, sent_ns=late_ns - 500 * MS - delay_ns), late_ns)
    assert receiver.is_on(late_ns) is is_on


def test_a_first_permit_is_compared_with_the_holds_before_it():
    receiver = _armed_receiver()
    receiver.accept(encode(Message(MessageKind.HOLD, at_ns=0, sent_ns=0)), 500 * MS)
    receiver.accept(_permit_packet(1, sent_ns=33 * MS), 533 * MS + MAX_TRANSIT_NS + 1)
    assert not receiver.is_on(533 * MS + MAX_TRANSIT_NS + 1)


def test_a_hold_is_obeyed_however_late_it_comes():
    receiver = _armed_receiver()
    receiver.accept(_permit_packet(1, sent_ns=0), 500 * MS)
    receiver.accept(encode(Message(MessageKind.HOLD, at_ns=1, sent_ns=1)), 560 * MS)
    assert not receiver.is_on(560 * MS)


def test_a_permit_overtaken_by_a_hold_is_refused():
    receiver = _armed_receiver()
    receiver.accept(encode(Message(MessageKind.HOLD, at_ns=50 * MS, sent_ns=50 * MS)), 500 * MS)
    receiver.accept(_permit_packet(1, sent_ns=50 * MS), 500 * MS)
    assert not receiver.is_on(500 * MS)
    receiver.accept(_permit_packet(2, sent_ns=50 * MS + 1), 500 * MS)
    assert receiver.is_on(500 * MS)


def test_a_latch_refuses_until_rearmed():
    receiver = _armed_receiver()
    receiver.accept(encode(Message(MessageKind.LATCH, at_ns=1, sent_ns=1)), 500 * MS)
    receiver.accept(_permit_packet(1, sent_ns=50 * MS), 550 * MS)
    assert not receiver.is_on(550 * MS)


@pytest.mark.parametrize("packet", [b"", b"TGB1", b"x" * 37, encode(Message(MessageKind.ASK))[:-1], b"\0" * 37])
def test_noise_on_the_socket_means_nothing(packet):
    receiver = _armed_receiver()
    receiver.accept(_permit_packet(1, sent_ns=0), 500 * MS)
    assert decode(packet) is None
    assert receiver.accept(packet, 500 * MS) is None
    assert receiver.is_on(500 * MS)
