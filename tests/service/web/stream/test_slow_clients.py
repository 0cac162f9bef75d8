"""Whoever does not keep up gets the newest and is told; whoever takes nothing is cut off; the others notice nothing."""

import time

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from tests.support.stream.stream_server import Served, messages, next_of, read_until, served
from tests.support.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.waiting


def test_clients_that_never_read_are_cut_off_and_the_others_stay_within_two_frames(tmp_path):
    with served(tmp_path, stall_s=1.0) as service:
        session_id = service.begin_session()
        with service.watch("?form=thin") as healthy, service.watch() as healthy_too:
            stalled = [service.raw("/api/v1/live") for _ in range(6)]
            stalled += [service.raw("/api/v1/live/events") for _ in range(2)]
            service.make_messages_big()
            service.await_clients(10)
            end_s = time.monotonic() + PATIENCE_S
            while sum(service.hub.reading().clients.values()) > 2:
                assert time.monotonic() < end_s, service.hub.reading()
                service.frames(1)
                for one in (healthy, healthy_too):
                    assert next_of(one, "sample")["frame_index"] == service.hub.newest.index
        service.await_closed("stalled", 8)
        assert service.hub.reading().skipped > 0
        for one in stalled:
            one.close()
        service.end_session(session_id)


def test_a_slow_client_is_reported_how_many_it_missed_and_gets_the_newest(service: Served, session_id: str):
    service.make_messages_big()
    slow = service.raw("/api/v1/live")
    service.await_clients(1)
    service.frames(40)
    assert next(iter(service.hub._clients)).slot.skipped > 10
    found = read_until(slow, bytearray(), service.hub.newest.index)
    slow.close()
    samples = [one for one in found if one["type"] == "sample"]
    dropped = [(slot, one) for slot, one in enumerate(found) if one["type"] == "dropped"]
    assert dropped
    for slot, one in dropped:
        before, after = found[slot - 1], found[slot + 1]
        assert after["sequence"] - before["sequence"] == one["skipped"] + 1
    assert len(samples) + sum(one["skipped"] for _, one in dropped) == 40


def test_little_waits_in_buffers_for_a_client_that_does_not_read(service: Served, session_id: str):
    service.make_messages_big()
    slow = service.raw("/api/v1/live")
    service.await_clients(1)
    service.frames(60)
    (client,) = service.hub._clients
    assert client.slot.skipped > 40, "of sixty messages of 20 kB hardly any is in a buffer"
    slow.close()


def test_a_stalled_client_that_comes_back_to_life_in_time_is_not_cut_off(service: Served, session_id: str):
    before = service.hub.reading().closed.get("stalled", 0)
    service.make_messages_big()
    slow, raw = service.raw("/api/v1/live"), bytearray()
    service.await_clients(1)
    service.frames(30)
    (client,) = service.hub._clients
    eventually(lambda: client.slot.busy_since_s is not None, detail=lambda: "it never stalled")
    read_until(slow, raw, 29)
    service.running.operator_hold = None
    service.frames(2)
    read_until(slow, raw, 31)
    assert service.hub.reading().closed.get("stalled", 0) == before
    slow.close()


def talk_for_ever(connection: ClientConnection) -> None:
    for _ in messages(connection):
        for _ in range(20):
            connection.send("hello?")


def test_who_talks_too_much_is_closed(service: Served):
    with service.watch() as chatty:
        next_of(chatty, "hello")
        with pytest.raises(ConnectionClosed) as closed:
            talk_for_ever(chatty)
    assert closed.value.rcvd is None or closed.value.rcvd.code == 1008


def test_the_places_are_bounded_for_both_kinds_together_and_come_free(tmp_path):
    with served(tmp_path, max_live_clients=2) as few, few.watch() as first:
        next_of(first, "hello")
        events = few.raw("/api/v1/live/events")
        few.await_clients(2)
        with few.watch() as third, pytest.raises(ConnectionClosed) as refused:
            next_of(third, "hello")
        assert (refused.value.rcvd.code, refused.value.rcvd.reason) == (1013, "full")
        with few.http() as client:
            answer = client.get("/api/v1/live/events")
        assert (answer.status_code, answer.json()["code"]) == (503, "stream_full")
        assert int(answer.headers["retry-after"]) > 0
        assert few.hub.reading().refused == 2
        events.close()
        few.await_clients(1)
        with few.watch() as again:
            assert next_of(again, "hello")
