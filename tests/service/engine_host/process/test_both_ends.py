"""What the two sides are made of, each for itself: queues that wait for a reader far away, and a service's silence."""

import os
import queue
import socket

import numpy as np
import pytest

from engine.control.outputs import LoopStatus
from engine.control.records import EngineStatus
from engine.control.turn_inputs import CommandQueue
from engine.core.clock import ManualClock
from engine.core.commands import SetReference
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningStatus
from engine.gating.gate import Interruption
from service.engine_host.process.channels import BulkChannel, ChannelClosedError, ControlChannel, SharedPage
from service.engine_host.process.engine_server import EngineServer, OutgoingQueue, UpdateSender
from service.engine_host.process.messages import CommandResult, EngineUpdate, Fault, Heartbeat, Opened, Presence
from service.engine_host.process.remote_engine import CountingQueue, RemoteEngine

pytestmark = pytest.mark.waiting

MS = 1_000_000


@pytest.fixture
def source():
    return queue.Queue(4)


def test_what_was_sent_stays_where_it_is_until_it_was_taken(source):
    outgoing = OutgoingQueue(lambda: source)
    for item in "abcd":
        source.put_nowait(item)
    assert outgoing.unsent() == ("a", "b", "c", "d")
    assert outgoing.unsent() == ()
    assert source.full(), "it counts as unwritten"
    outgoing.acknowledge(1)
    outgoing.acknowledge(1)
    assert list(source.queue) == ["b", "c", "d"]
    source.put_nowait("e")
    assert outgoing.unsent() == ("e",)
    outgoing.acknowledge(4)
    assert list(source.queue) == ["e"]


def test_nothing_is_received_that_was_not_sent(source):
    outgoing = OutgoingQueue(lambda: source)
    source.put_nowait("a")
    outgoing.acknowledge(9)
    assert list(source.queue) == ["a"]
    assert outgoing.unsent() == ("a",)
    outgoing.acknowledge(0)
    assert list(source.queue) == ["a"], "a word that comes late takes nothing back"
    outgoing.discard_sent()
    assert source.empty()


def test_only_what_its_reader_took_is_counted():
    taken = CountingQueue()
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
    return CommandQueue(clock=clock, capacity=4, longest_silence_ns=500 * MS), clock


def test_an_engine_without_a_service_has_no_silence_check(mailbox):
    box, clock = mailbox
    clock.advance_ns(10_000 * MS)
    assert box.take_report(is_armed=True) is None


def test_a_service_is_silent_from_its_bound_on_for_an_armed_gate_until_the_next_heartbeat(mailbox):
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


def test_a_fault_that_was_left_is_reported_first(mailbox):
    box, clock = mailbox
    box.note_service(clock.now_ns())
    clock.advance_ns(600 * MS)
    box.report(Interruption(HoldReason.DISK_LOW, "20 MB"))
    assert box.take_report(is_armed=True).reason is HoldReason.DISK_LOW
    assert box.take_report(is_armed=True).reason is HoldReason.SERVICE_SILENT


class Recording:
    """Stands for an engine, a journal, whatever is called: notes what is asked of it, in order."""

    def __init__(self, calls=None, name="") -> None:
        self.calls = [] if calls is None else calls
        self._name = name
        self.samples, self.transitions, self.notices = queue.Queue(), queue.Queue(), queue.Queue()
        self.status = EngineStatus(run_state=LoopStatus.RUNNING)

    def on_turn(self, _send_updates) -> None:
        """Nothing is reported in between."""

    def evidence(self):
        self.calls.append("evidence")
        return {}

    def __getattr__(self, called):
        if called.startswith("__"):
            raise AttributeError(called)
        if called in {"page", "control"}:
            return self
        return lambda *said, **_more: self.calls.append((f"{self._name}{called}", *said)) or True


@pytest.fixture
def served():
    """A server on a recording engine, and the service's two ends."""
    bulk, child_bulk = socket.socketpair()
    control, child_control = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    file = SharedPage.make()
    engine = Recording()
    server = EngineServer(
        engine,
        Recording(engine.calls, "journal "),
        bulk=BulkChannel(child_bulk),
        control=ControlChannel(child_control),
        page=SharedPage(file),
    )
    os.close(file)
    ends = BulkChannel(bulk), ControlChannel(control)
    yield engine, server, *ends
    for end in (*ends, server._bulk, server._control):
        end.close()


def test_an_answer_that_comes_while_the_rest_is_read_waits_for_the_next_news(served):
    _, server, _, _ = served
    sender = server._sender

    class Racing(Recording):
        @property
        def status(self):
            sender.answer(1, None)
            return EngineStatus()

        @status.setter
        def status(self, _status):
            """It is always this one."""

    sender._engine = Racing()
    assert sender._next_update(LoopStatus.RUNNING).answers == (), "what it is about may be newer than what was read"
    assert [one.number for one in sender._next_update(LoopStatus.RUNNING).answers] == [1]


def test_the_end_is_emitted_once_even_if_its_queue_was_full_before(served):
    _, server, _, _ = served
    kept = ["three", "two"]

    class Over(Recording):
        @property
        def transitions(self):
            if self.full.empty() and kept:
                self.full.put_nowait(kept.pop())
            return self.full

        @transitions.setter
        def transitions(self, _queue):
            self.full = queue.Queue(1)
            self.full.put_nowait("one")

    engine, sent = Over(), []
    engine.status = EngineStatus(run_state=LoopStatus.ENDED)
    sender = UpdateSender(engine, Recording(), server._page)
    sender._bulk.send = sent.append
    sender.run()
    assert [news.transitions for news in sent] == [("one",), ("two",), ("three",), ()]
    assert [news.status.is_over for news in sent] == [False, False, False, True]


def test_who_has_an_answer_finds_all_that_came_with_it():
    engine = RemoteEngine(Recording(), None, on_end=lambda **_: None, server_turned_ns=lambda: 1)
    asked = engine.submit(SetReference(operator="ann"))
    found = []
    asked.add_done_callback(lambda _: found.append((engine.status, engine.transitions.qsize())))
    status = EngineStatus(run_state=LoopStatus.RUNNING, learning=LearningStatus(has_reference=True))
    engine._apply(EngineUpdate(status=status, transitions=("one",), answers=(CommandResult(number=1, error=None),)))
    ((shown, transitions),) = found
    assert (shown.run_state, shown.learning.has_reference, transitions) == (LoopStatus.RUNNING, True, 1)
    assert asked.result(0.0) is None


def test_a_picture_can_be_read_though_the_engine_s_messages_of_it_are_late(served):
    _, server, _, _ = served
    engine = RemoteEngine(Recording(), None, on_end=lambda **_: None, server_turned_ns=lambda: 1)
    engine._child.page = server._page
    assert engine.picture() is None
    for frame_index in range(20):
        server._page.write_picture(frame_index, np.full((4, 6, 3), frame_index, np.uint8))
    frame_index, picture = engine.picture()
    assert (frame_index, int(picture[0, 0, 0])) == (19, 19)


def test_who_sees_the_end_finds_everything_there():
    engine = RemoteEngine(Recording(), None, on_end=lambda **_: None, server_turned_ns=lambda: 1)
    seen = []

    class Watched(CountingQueue):
        def put(self, item):
            seen.append(engine.status.is_over)
            super().put(item)

    engine.samples, engine.transitions, engine.notices = Watched(), Watched(), Watched()
    over = EngineStatus(run_state=LoopStatus.ENDED)
    engine._apply(EngineUpdate(status=over, samples=("a",), transitions=("b",), notices=("c",)))
    assert (seen, engine.status.run_state) == ([False] * 3, LoopStatus.ENDED)


def test_what_the_service_whispers_reaches_the_engine_as_it_was_stated(served):
    engine, server, _, control = served
    control.send(Heartbeat(alive_ns=7, samples=0, transitions=0, notices=0, acknowledged=3))
    control.send(Presence(operator="ann"))
    control.send(Fault(reason=HoldReason.DISK_LOW, detail="20 MB"))
    control.close()
    server.serve(5)
    assert engine.calls[:5] == [
        ("note_service", 5),
        ("note_service", 7),
        ("journal acknowledge", 3),
        ("note_presence", "ann"),
        ("report_fault", HoldReason.DISK_LOW, "20 MB"),
    ]


def test_a_service_that_is_gone_has_the_line_held_before_anything_that_may_take_time(served):
    engine, server, bulk, control = served
    control.close()
    server.serve(5)
    assert engine.calls == [
        ("note_service", 5),
        ("report_fault", HoldReason.SERVICE_SILENT, "the service's process has ended"),
        ("hold_line", HoldReason.SERVICE_SILENT),
        ("stop",),
        ("journal close",),
        "evidence",
    ]
    assert isinstance(bulk.receive(), Opened)


def test_a_service_that_ends_before_the_start_message_leaves_no_engine_behind(served):
    engine, server, bulk, control = served
    bulk.close()
    control.close()
    with pytest.raises(ChannelClosedError):
        server.serve(5)
    assert ("hold_line", HoldReason.SERVICE_SILENT) in engine.calls
    assert ("stop",) in engine.calls


def test_a_teller_that_breaks_ends_the_process_with_the_line_held(served, monkeypatch):
    engine, server, _, _ = served
    monkeypatch.setattr(server._sender, "run", lambda: 1 / 0)
    with pytest.raises(SystemExit):
        server.serve(5)
    assert ("hold_line", HoldReason.ENGINE_FAILED) in engine.calls
