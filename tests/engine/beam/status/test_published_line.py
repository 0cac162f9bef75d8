"""Those who only want to know are reported what was read back and why, and can disturb nothing."""

import json
import re
import socket
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.beam.status.published_line import (
    GOOD_FOR_NS,
    BeamState,
    HttpSender,
    LineStatus,
    PublishedBeamLine,
    StatusPublisher,
    UdpSender,
)
from engine.core.clock import NS_PER_S, ManualClock, MonotonicClock
from engine.core.errors import BeamLineError, BeamLineMismatchError
from engine.core.gate_state import HoldReason, Lease
from tests.support.beam.stepped_line import MS
from tests.support.contract.schemas import Schema
from tests.support.repository import ROOT

PATIENCE_S = 20.0
PAGE = ROOT / "docs" / "3-operate" / "beam.md"


class Kept:
    """A sender that keeps what it is given, or fails."""

    def __init__(self, room=64):
        self.queue_size, self.fails, self.was_closed = room, False, False
        self.messages = []

    def send(self, message):
        if self.fails:
            raise OSError("nobody listens")
        self.messages.append(json.loads(message))

    def close(self):
        self.was_closed = True


class Stepped(StatusPublisher):
    """Without its thread: the test announces."""

    def start(self):
        self._next_beat_ns = self._clock.now_ns()


def announcer_of(sender, clock):
    return Stepped(sender, clock, utc_now=lambda: "2026-11-21T03:00:00.000Z")


class Published:
    def __init__(self, line=SimulatedBeamLine, room=64):
        self.clock = ManualClock(100 * MS)
        self.line, self.sender = line(self.clock), Kept(room)
        self.announcer = announcer_of(self.sender, self.clock)
        self.published = PublishedBeamLine(self.line, [self.announcer], self.clock)
        self.published.open()
        self.published.rearm()

    def permit(self):
        self.clock.advance_ns(MS)
        now_ns = self.clock.now_ns()
        self.published.permit(Lease(granted_ns=now_ns, expires_ns=now_ns + 80 * MS, sequence=now_ns))

    def messages(self):
        self.announcer.send_pending()
        return [(m["kind"], m["beam"], m["permitted"], m["reason"], m["trouble"]) for m in self.sender.messages]


def test_every_change_is_reported_once_with_what_was_read_back_and_why():
    held = Published()
    held.permit()
    for _ in range(3):
        assert held.published.is_on()
    held.published.hold(HoldReason.OUTSIDE_WINDOW)
    assert not held.published.is_on()
    assert held.messages() == [
        ("change", "off", False, "disarmed", None),
        ("change", "on", True, None, None),
        ("change", "on", False, "outside_window", None),
        ("change", "off", False, "outside_window", None),
    ]


def test_messages_are_numbered_and_carry_time_and_age():
    held = Published()
    held.permit()
    assert held.published.is_on()
    held.clock.advance_ns(3 * MS)
    held.announcer.send_pending()
    assert [message["sequence"] for message in held.sender.messages] == [1, 2]
    assert held.sender.messages[-1]["age_ms"] == 3.0
    assert held.sender.messages[-1]["sent_at"] == "2026-11-21T03:00:00.000Z"


def test_an_on_that_is_no_longer_confirmed_becomes_unknown():
    held = Published()
    held.permit()
    assert held.published.is_on()
    assert held.messages()[-1][1] == "on"
    held.clock.advance_ns(GOOD_FOR_NS + 1)
    assert held.messages()[-1][:2] == ("change", "unknown")
    count = len(held.messages())
    assert len(held.messages()) == count


def test_a_heartbeat_reports_once_a_second_what_is_known():
    held = Published()
    assert len(held.messages()) == 1
    held.clock.advance_ns(NS_PER_S - 1)
    assert len(held.messages()) == 1
    held.clock.advance_ns(1)
    assert held.messages()[1:] == [("heartbeat", "off", False, "disarmed", None)]


class Troubled(SimulatedBeamLine):
    is_in_trouble = False

    def is_on(self):
        if self.is_in_trouble:
            raise BeamLineMismatchError("stuck")
        return super().is_on()


def test_a_trouble_is_reported_as_unknown_and_passed_on_unchanged():
    held = Published(Troubled)
    held.line.is_in_trouble = True
    with pytest.raises(BeamLineMismatchError, match="stuck"):
        held.published.is_on()
    assert held.messages()[-1] == ("change", "unknown", False, "disarmed", "stuck")
    received = []
    held.published.on_trouble = lambda reason, detail: received.append((reason, detail))
    held.line.on_trouble(HoldReason.BEAM_LINE_FAILED, "silent")
    assert received == [(HoldReason.BEAM_LINE_FAILED, "silent")]
    assert held.messages()[-1] == ("change", "unknown", False, "beam_line_failed", "silent")


def test_a_trouble_that_the_line_finds_while_it_is_on_is_reported_as_unknown_at_once():
    held = Published()
    held.permit()
    assert held.published.is_on()
    held.line.on_trouble(HoldReason.BEAM_LINE_FAILED, "silent")
    assert held.messages()[-1] == ("change", "unknown", False, "beam_line_failed", "silent")


def test_the_line_is_commanded_first_and_acts_alike_published_or_not():
    held = Published()
    held.permit()
    assert held.line.is_on()
    held.published.hold(HoldReason.WATCHDOG)
    assert not held.line.is_on()
    held.clock.advance_ns(MS)
    with pytest.raises(BeamLineError, match="latched"):
        held.permit()
    held.published.close()
    assert held.sender.was_closed is False  # it has no thread here; the real one closes at its end


@pytest.mark.parametrize("room", [1, 3])
def test_what_finds_no_room_pushes_the_oldest_out_and_is_counted(room):
    held = Published(room=room)
    for reason in (HoldReason.JUMP, HoldReason.DWELL, HoldReason.TRAINING, HoldReason.OUTSIDE_WINDOW):
        held.published.hold(reason)
    held.announcer.send_pending()
    newest = ["jump", "dwell", "training", "outside_window"][-room:]
    assert [message["reason"] for message in held.sender.messages] == newest
    assert held.announcer.dropped == 5 - room


def test_a_recipient_without_an_answer_is_counted_and_sent_again_at_the_next_heartbeat():
    held = Published()
    held.sender.fails = True
    held.announcer.send_pending()
    assert (held.announcer.sent, held.announcer.failures, held.announcer.last_error) == (0, 1, "nobody listens")
    held.sender.fails = False
    held.clock.advance_ns(NS_PER_S)
    assert held.messages() == [("heartbeat", "off", False, "disarmed", None)]


def _schema():
    return json.loads(re.search(r"```json\n(\{.*?\n\})\n```", PAGE.read_text(), re.DOTALL).group(1))


def test_the_schema_in_the_documentation_is_what_is_sent():
    validator = Schema(_schema())
    held = Published(Troubled)
    held.permit()
    held.published.is_on()
    held.line.on_trouble(HoldReason.BEAM_LINE_FAILED, "silent")
    held.announcer.send_pending()
    held.clock.advance_ns(2 * NS_PER_S)
    held.announcer.send_pending()
    assert len(held.sender.messages) == 4
    for message in held.sender.messages:
        validator.validate(message)
    assert not validator.is_valid({**held.sender.messages[0], "beam": "perhaps"})
    assert not validator.is_valid({**held.sender.messages[0], "more": 1})


def _announced(sender, changes=1):
    """Tell real news through a real thread; return the announcer, stopped."""
    clock = MonotonicClock()
    announcer = StatusPublisher(sender, clock, utc_now=lambda: "2026-11-21T03:00:00.000Z")
    announcer.start()
    for number in range(changes):
        reason = HoldReason.JUMP if number % 2 else HoldReason.DWELL
        news = LineStatus(beam=BeamState.OFF, is_permitted=False, reason=reason, trouble=None, at_ns=clock.now_ns())
        announcer.publish(news)
    announcer.stop()
    return announcer


def test_a_datagram_is_sent_for_each_change():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(PATIENCE_S)
        announcer = _announced(UdpSender("127.0.0.1", listener.getsockname()[1]), changes=5)
        messages = [json.loads(listener.recv(4096)) for _ in range(5)]
    assert [message["reason"] for message in messages] == ["dwell", "jump", "dwell", "jump", "dwell"]
    assert announcer.failures == 0


class _Listener(BaseHTTPRequestHandler):
    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.received.append((self.path, self.headers["Content-Type"], json.loads(body)))
        self.send_response(self.server.status)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_arguments):
        """Say nothing."""


@pytest.fixture
def listener():
    server = HTTPServer(("127.0.0.1", 0), _Listener)
    server.received, server.status = [], 204
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def test_the_newest_state_is_posted_as_json(listener):
    announcer = _announced(HttpSender(f"http://127.0.0.1:{listener.server_port}/beam?room=2", timeout_s=PATIENCE_S))
    path, content_type, message = listener.received[-1]
    assert (path, content_type, message["reason"]) == ("/beam?room=2", "application/json", "dwell")
    assert announcer.failures == 0


@pytest.mark.parametrize("status", [302, 404, 500])
def test_an_answer_that_is_not_2xx_is_a_failure(listener, status):
    listener.status = status
    announcer = _announced(HttpSender(f"http://127.0.0.1:{listener.server_port}/", timeout_s=PATIENCE_S))
    assert (announcer.sent, announcer.last_error) == (0, f"answered {status}")


@pytest.mark.timeout(15)
def test_a_listener_that_never_answers_does_not_block_and_times_out():
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        sender = HttpSender(f"http://127.0.0.1:{silent.getsockname()[1]}/", timeout_s=0.1)
        with pytest.raises(TimeoutError):
            sender.send(b"{}")


def test_a_datagram_to_an_unresolvable_name_is_a_failure():
    with pytest.raises(OSError, match=r"."):
        UdpSender("no-such-host.invalid", 9).send(b"{}")
