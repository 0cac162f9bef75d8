"""What the two sides are made of, each for itself: queues that wait for a reader far away, and a service's silence."""

import queue

import pytest

from engine.clock import ManualClock
from engine.mailbox import Mailbox
from engine.permits import HoldReason
from engine.stages.gate import Interruption
from service.engine_process.remote import Taken
from service.engine_process.serving import Departing

MS = 1_000_000


@pytest.fixture
def source():
    return queue.Queue(4)


def test_what_was_sent_stays_where_it_is_until_it_was_taken(source):
    departing = Departing(lambda: source)
    for item in "abcd":
        source.put_nowait(item)
    assert departing.unsent() == ("a", "b", "c", "d")
    assert departing.unsent() == ()
    assert source.full(), "it counts as unwritten"
    departing.taken(1)
    departing.taken(1)
    assert list(source.queue) == ["b", "c", "d"]
    source.put_nowait("e")
    assert departing.unsent() == ("e",)
    departing.taken(4)
    assert list(source.queue) == ["e"]


def test_nobody_takes_what_was_not_sent(source):
    departing = Departing(lambda: source)
    source.put_nowait("a")
    departing.taken(9)
    assert list(source.queue) == ["a"]
    assert departing.unsent() == ("a",)
    departing.taken(0)
    assert list(source.queue) == ["a"], "a word that comes late takes nothing back"
    departing.let_go()
    assert source.empty()


def test_only_what_its_reader_took_is_counted():
    taken = Taken()
    taken.put("a")
    taken.put("b")
    assert (taken.count, taken.qsize()) == (0, 2)
    assert taken.get_nowait() == "a"
    assert taken.get(timeout=1.0) == "b"
    with pytest.raises(queue.Empty):
        taken.get_nowait()
    assert taken.count == 2


@pytest.fixture
def mailbox():
    clock = ManualClock(1_000 * MS)
    return Mailbox(clock=clock, capacity=4, longest_silence_ns=500 * MS), clock


def test_an_engine_that_never_heard_of_a_service_has_none_that_could_be_silent(mailbox):
    box, clock = mailbox
    clock.advance_ns(10_000 * MS)
    assert box.take_report(is_armed=True) is None


def test_a_service_is_silent_from_its_bound_on_for_an_armed_gate_and_until_it_is_heard(mailbox):
    box, clock = mailbox
    box.note_service(clock.now_ns())
    clock.advance_ns(500 * MS)
    assert box.take_report(is_armed=True) is None
    clock.advance_ns(1)
    assert box.take_report(is_armed=False) is None
    for _ in range(3):
        report = box.take_report(is_armed=True)
        assert report == Interruption(HoldReason.SERVICE_SILENT, "nothing heard of the service for 500 ms")
    box.note_service(clock.now_ns())
    assert box.take_report(is_armed=True) is None


def test_what_was_on_its_way_for_long_makes_no_service_younger(mailbox):
    box, clock = mailbox
    box.note_service(clock.now_ns())
    clock.advance_ns(600 * MS)
    box.note_service(clock.now_ns() - 550 * MS)
    assert box.take_report(is_armed=True) is not None
    box.note_service(clock.now_ns())
    box.note_service(clock.now_ns() - 550 * MS)
    assert box.take_report(is_armed=True) is None, "the newest counts"


def test_a_fault_that_was_left_is_told_first(mailbox):
    box, clock = mailbox
    box.note_service(clock.now_ns())
    clock.advance_ns(600 * MS)
    box.report(Interruption(HoldReason.DISK_LOW, "20 MB"))
    assert box.take_report(is_armed=True).reason is HoldReason.DISK_LOW
    assert box.take_report(is_armed=True).reason is HoldReason.SERVICE_SILENT
