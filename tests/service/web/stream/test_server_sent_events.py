"""The same stream as server-sent events."""

import json
from collections.abc import Iterator

import httpx2
import pytest

from tests.support.stream.stream_server import Served
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

PATH = "/api/v1/live/events"


def events_of(answer: httpx2.Response) -> Iterator[dict]:
    """Take the stream apart: fields of an event, or a comment under the name of none."""
    event: dict = {}
    for line in answer.iter_lines():
        if line == "":
            yield event
            event = {}
            continue
        name, _, value = line.partition(":")
        event[name] = value.removeprefix(" ")


def next_of(events: Iterator[dict], kind: str) -> dict:
    return next(event for event in events if event.get("event") == kind)


def test_events_carry_the_messages_of_the_stream_with_the_frame_as_their_id(service: Served, session_id: str):
    with service.http() as client, client.stream("GET", PATH, params={"form": "thin"}) as answer:
        events = events_of(answer)
        assert next(events) == {"retry": "1000"}
        hello = json.loads(next_of(events, "hello")["data"])
        service.frames(1)
        first = next_of(events, "sample")
        service.frames(1)
        second = next_of(events, "sample")
    assert hello["form"] == "thin"
    assert (first["id"], second["id"]) == (f"{session_id}:0", f"{session_id}:1")
    assert json.loads(second["data"])["frame_index"] == 1


def test_nothing_between_keeps_the_events_back(service: Served):
    with service.http() as client, client.stream("GET", PATH) as answer:
        assert answer.status_code == 200
        headers = answer.headers
    assert headers["content-type"] == "text/event-stream"
    assert headers["cache-control"] == "no-store"
    assert headers["x-accel-buffering"] == "no"
    assert "content-length" not in headers
    assert "content-encoding" not in headers


def test_a_browser_that_comes_back_goes_on_after_its_last_event(service: Served, session_id: str):
    with service.watch():
        service.frames(8)
        service.recorded(session_id, 7)
        headers = {"Last-Event-ID": f"{session_id}:4"}
        with service.http() as client, client.stream("GET", PATH, headers=headers) as answer:
            events = events_of(answer)
            found = [next_of(events, "sample") for _ in range(3)]
            assert json.loads(next_of(events, "resumed")["data"])["last_frame"] == 7
    assert [event["id"] for event in found] == [f"{session_id}:{index}" for index in (5, 6, 7)]


@pytest.mark.parametrize("given", ["", "7", f"{'0' * 32}:", f"{'0' * 32}:x", f"{'0' * 32}:{'9' * 30}"])
def test_a_last_event_that_is_none_of_ours_is_refused(service: Served, given: str):
    with service.http() as client:
        answer = client.get(PATH, headers={"Last-Event-ID": given})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_value")


def test_comments_come_where_nothing_else_does(service: Served, session_id: str):
    with service.http() as client, client.stream("GET", PATH) as answer:
        events = events_of(answer)
        service.frames(1)
        next_of(events, "sample")
        assert next(event for event in events if "" in event)[""] == "ping"


def test_the_stream_ends_when_the_log_in_does(service: Served):
    with service.http() as client:
        with client.stream("GET", PATH) as answer:
            events = events_of(answer)
            next_of(events, "hello")
            closed = service.hub.reading().closed
            before, stalled = closed.get("not_logged_in", 0), closed.get("stalled", 0)
            authenticator = service.app.state.access.authenticator
            whole, authenticator.is_valid = authenticator.is_valid, lambda _identity: False
            try:
                assert list(events) is not None, "it ends"
            finally:
                authenticator.is_valid = whole
        service.await_closed("not_logged_in", before + 1)
        assert service.hub.reading().closed.get("stalled", 0) == stalled


def test_a_client_that_goes_leaves_its_place(service: Served):
    with service.http() as client, client.stream("GET", PATH) as answer:
        events = events_of(answer)  # kept: httpx closes an answer that nobody iterates over any more
        next_of(events, "hello")
        assert service.hub.reading().clients == {("sse", "full"): 1}
    eventually(lambda: not service.hub.reading().clients)
