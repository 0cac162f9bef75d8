"""How news is sent: each piece once, in time, counted; by a thread that no one has to wait for."""

import http.client
import queue
import socket
import threading

import pytest

from engine.beam.status import published_line as announcing
from engine.beam.status.published_line import (
    CLOSE_S,
    GOOD_FOR_NS,
    HEARTBEAT_NS,
    USER_AGENT,
    BeamState,
    HttpSender,
    LineStatus,
    StatusPublisher,
    UdpSender,
)
from engine.core.clock import NS_PER_S, ManualClock
from engine.core.gate_state import HoldReason
from tests.support.beam.stepped_line import MS


class Kept:
    """A sender that keeps what it is given, or fails."""

    queue_size = 8

    def __init__(self):
        self.error, self.sent, self.closes = None, [], 0

    def send(self, message):
        if self.error is not None:
            raise self.error
        self.sent.append(message)

    def close(self):
        self.closes += 1


def made(clock):
    return StatusPublisher(Kept(), clock, utc_now=lambda: "2026-11-21T03:00:00.000Z")


def news(beam=BeamState.OFF, reason=HoldReason.DWELL, at_ns=0):
    return LineStatus(beam=beam, is_permitted=reason is None, reason=reason, trouble=None, at_ns=at_ns)


def test_sent_and_failed_messages_are_counted_one_by_one():
    held = made(ManualClock(5 * MS))
    for reason in (HoldReason.DWELL, HoldReason.JUMP, HoldReason.TRAINING):
        held.publish(news(reason=reason))
    held.send_pending()
    assert (held.sent, held.failures, held.last_error) == (3, 0, None)
    held._sender.error = OSError()
    for reason in (HoldReason.DWELL, HoldReason.JUMP):
        held.publish(news(reason=reason))
    held.send_pending()
    assert (held.sent, held.failures, held.last_error) == (3, 2, "OSError")
    held._sender.error = OSError("nobody listens")
    held.publish(news(reason=HoldReason.DWELL))
    held.send_pending()
    assert (held.failures, held.last_error) == (3, "nobody listens")


def test_it_rests_until_the_next_heartbeat_and_where_the_line_is_on_no_longer_than_that_is_good_for():
    clock = ManualClock(7 * NS_PER_S)
    held = made(clock)
    held.publish(news(at_ns=clock.now_ns()))
    held.send_pending()
    assert held._wait_ns() == HEARTBEAT_NS
    clock.advance_ns(300 * MS)
    assert held._wait_ns() == HEARTBEAT_NS - 300 * MS
    clock.advance_ns(2 * NS_PER_S)
    assert held._wait_ns() == 1
    held.publish(news(BeamState.ON, None, clock.now_ns()))
    held.send_pending()
    assert held._wait_ns() == GOOD_FOR_NS


def test_its_thread_waits_no_longer_than_that_for_the_bell():
    clock = ManualClock(7 * NS_PER_S)
    held = made(clock)
    held.publish(news())
    waited = []

    class Bell:
        def get(self, timeout):
            waited.append(timeout)
            held._stop_requested.set()
            raise queue.Empty

    held._wakeups = Bell()
    held._work()
    assert waited == [HEARTBEAT_NS / NS_PER_S]
    assert held._sender.closes == 1


def test_its_thread_is_named_and_keeps_no_process_alive_and_stopping_waits_for_it_a_second_at_most(monkeypatch):
    made_threads = []

    class Thread:
        def __init__(self, **options):
            self.options, self.joined = options, []
            made_threads.append(self)

        def start(self):
            """It is not run."""

        def join(self, timeout):
            self.joined.append(timeout)

    monkeypatch.setattr(announcing.threading, "Thread", Thread)
    held = made(ManualClock(0))
    held.start()
    held.stop()
    held.stop()
    (thread,) = made_threads
    assert thread.options == {"target": held._work, "name": "tidegate-beam-status", "daemon": True}
    assert thread.joined == [CLOSE_S]


class Answered:
    """A connection that answers what it is set to, and keeps what it was asked."""

    made: "list[Answered]"
    status = 204

    def __init__(self, host, port, *, timeout):
        self.to, self.asked, self.is_open = (host, port, timeout), [], True
        type(self).made.append(self)

    def request(self, method, path, *, body, headers):
        self.asked.append((method, path, body, headers))

    def getresponse(self):
        return self

    def close(self):
        self.is_open = False


@pytest.fixture
def answered(monkeypatch):
    plain = type("Plain", (Answered,), {"made": []})
    secure = type("Secure", (Answered,), {"made": []})
    monkeypatch.setattr(http.client, "HTTPConnection", plain)
    monkeypatch.setattr(http.client, "HTTPSConnection", secure)
    return plain, secure


@pytest.mark.parametrize(
    ("url", "is_secure", "to", "path"),
    [
        ("http://gate.test", False, ("gate.test", None, 0.5), "/"),
        ("https://gate.test:8443/beam", True, ("gate.test", 8443, 0.5), "/beam"),
        ("https://gate.test/beam?room=2", True, ("gate.test", None, 0.5), "/beam?room=2"),
        ("http:///nowhere", False, ("", None, 0.5), "/nowhere"),
    ],
)
def test_a_message_is_posted_to_where_the_address_states_and_how(answered, url, is_secure, to, path):
    HttpSender(url, timeout_s=0.5).send(b"{}")
    plain, secure = answered
    (connection,) = (secure if is_secure else plain).made
    assert (plain if is_secure else secure).made == []
    headers = {"Content-Type": "application/json", "User-Agent": USER_AGENT}
    assert (connection.to, connection.asked) == (to, [("POST", path, b"{}", headers)])
    assert not connection.is_open


@pytest.mark.parametrize(("status", "is_good"), [(199, False), (200, True), (299, True), (300, False), (301, False)])
def test_only_what_is_2xx_is_an_answer(answered, status, is_good):
    answered[0].status = status
    sender = HttpSender("http://gate.test/", timeout_s=0.5)
    if is_good:
        sender.send(b"{}")
        return
    with pytest.raises(OSError, match=f"^answered {status}$"):
        sender.send(b"{}")


def test_a_datagram_goes_over_the_family_kind_and_protocol_that_the_name_has(monkeypatch):
    asked = []

    class Socket:
        def __init__(self, *what):
            asked.append(what)

        def connect(self, address):
            asked.append(address)

        def send(self, message):
            asked.append(message)

        def close(self):
            asked.append("closed")

    found = (socket.AF_INET6, socket.SOCK_DGRAM, 17, "", ("::1", 9, 0, 0))

    def look_up(host, port, **options):
        asked.append((host, port, options))
        return [found, None]

    monkeypatch.setattr(announcing.socket, "getaddrinfo", look_up)
    monkeypatch.setattr(announcing.socket, "socket", Socket)
    sender = UdpSender("gate.test", 9)
    sender.send(b"a")
    sender.send(b"b")
    sender.close()
    sender.close()
    looked_up = ("gate.test", 9, {"type": socket.SOCK_DGRAM})
    assert asked == [looked_up, found[:3], found[4], b"a", b"b", "closed"]


@pytest.mark.parametrize(
    ("beam", "at_ns", "now_ns", "known"),
    [
        (BeamState.ON, 1_000 * MS, 1_000 * MS + GOOD_FOR_NS, BeamState.ON),
        (BeamState.ON, 1_000 * MS, 1_001 * MS + GOOD_FOR_NS, BeamState.UNKNOWN),
        (BeamState.OFF, 0, 10**12, BeamState.OFF),
    ],
)
def test_an_on_is_good_for_a_quarter_of_a_second(beam, at_ns, now_ns, known):
    assert news(beam, at_ns=at_ns).aged(now_ns).beam is known


def test_news_of_another_time_are_the_same_and_their_age_is_given_to_a_tenth_of_a_millisecond():
    assert news(at_ns=1).is_same(news(at_ns=2))
    assert not news(at_ns=1).is_same(news(reason=HoldReason.JUMP, at_ns=1))
    document = news(at_ns=MS).document(kind="change", sequence=1, sent_at="now", now_ns=3_460_000)
    assert document["age_ms"] == 2.5


def test_no_publisher_thread_remains():
    before = threading.active_count()
    held = made(ManualClock(0))
    held.start()
    held.publish(news())
    held.stop()
    assert threading.active_count() == before
    assert len(held._sender.sent) == 1
