"""The live stream as the client follows it: events, breaks, silence, and what it asks for afterwards."""

import json

import pytest

from service import client as module
from service.client import AnswerError, ProblemError, UnreachableError
from tests.support.client.scripted_server import cuts, refuses, says, writes

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream; charset=utf-8\r\nConnection: close\r\n\r\n"
SESSION = "0" * 32


def event(number, *, ends=b"\n"):
    data = json.dumps({"type": "sample", "frame_index": number}).encode()
    return ends.join([b"event: sample", b"id: s-%d" % number, b"data: " + data, b"", b""])


def frames(messages, count):
    found = []
    for message in messages:
        found.append(message["frame_index"])
        if len(found) == count:
            return found
    return found


def test_events_come_as_messages_and_comments_are_passed_over(client, script):
    script.steps = [writes(HEAD + b": ping\n\n" + event(1) + event(2, ends=b"\r\n") + b": ping\n\n" + event(3))]
    assert frames(client.live(), 3) == [1, 2, 3]
    assert script.requests[0].path == "/api/v1/live/events?form=thin"
    assert script.requests[0].headers["accept"] == "text/event-stream"


def test_a_stream_that_breaks_is_taken_up_behind_its_last_whole_event(client, script, waits):
    script.steps = [
        writes(HEAD + event(1) + event(2) + b"id: s-3\ndata: {"),
        cuts,
        refuses(503, "service_stopping", Retry_After="1"),
        writes(HEAD + event(3) + event(4)),
    ]
    messages = client.live(session_id=SESSION, after_frame=0, rate_hz=10)
    assert frames(messages, 4) == [1, 2, 3, 4]
    assert [one.headers.get("last-event-id") for one in script.requests] == [None, "s-2", "s-2", "s-2"]
    assert waits == [0.2, 0.4, 1.0]
    assert f"session_id={SESSION}&after_frame=0&rate_hz=10&form=thin" in script.requests[3].path


def test_a_stream_that_is_silent_for_too_long_counts_as_broken(client, script):
    def silent(handler):
        handler.wfile.write(HEAD + event(1))
        handler.rfile.read(1)  # until the client goes

    script.steps = [silent, writes(HEAD + event(2))]
    assert frames(client.live(silence_s=0.1), 2) == [1, 2]


def test_a_stream_that_brings_nothing_any_more_is_given_up(client, script, waits):
    script.steps = [writes(HEAD + event(1)), cuts]
    messages = client.live(reconnects=3)
    assert next(messages)["frame_index"] == 1
    with pytest.raises(UnreachableError):
        next(messages)
    assert len(script.requests) == 4
    assert waits == [0.2, 0.4, 0.8]


def test_a_stream_that_breaks_often_and_brings_something_each_time_is_not_given_up(client, script):
    script.steps = [writes(HEAD + event(number)) for number in range(1, 6)]
    assert frames(client.live(reconnects=1), 5) == [1, 2, 3, 4, 5]


def test_a_page_without_the_permission_shows_it_and_does_not_retry(client, script):
    script.steps = [refuses(403, "permission_missing")]
    with pytest.raises(ProblemError, match="permission_missing"):
        next(client.live())
    assert len(script.requests) == 1


@pytest.mark.parametrize("data", [b"data: {\n\n", b"data: []\n\n", b"data: " + b"x" * 2000 + b"\n\n"])
def test_what_is_no_message_ends_the_stream_loudly(client, script, monkeypatch, data):
    monkeypatch.setattr(module, "MAX_EVENT_BYTES", 1000)
    script.steps = [writes(HEAD + data)]
    with pytest.raises(AnswerError):
        next(client.live())


def test_what_is_no_stream_is_refused(client, script):
    script.steps = [says({})]
    with pytest.raises(AnswerError, match="application/json"):
        next(client.live())
