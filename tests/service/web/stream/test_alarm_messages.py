"""Alarms in the stream: the present ones first, then each event, before everything else and to every client."""

import json
from collections.abc import Iterator

import anyio
import pytest

from engine.core.clock import NS_PER_S
from service.web.stream.client_slot import MAX_ALARMS
from tests.support.stream.fake_runner import EVENTS, JSON, THIN, FakeRunner, make_hub

A = "a" * 32
LOST, BEAM = "source_lost", "beam_without_permit"


@pytest.fixture
def runner() -> FakeRunner:
    return FakeRunner()


def look(runner: FakeRunner, *codes: str) -> None:
    runner.ns += NS_PER_S
    runner.alarms.update(A, dict.fromkeys(codes, "why"), runner.ns)


def waiting(client) -> Iterator[dict]:
    while (message := client.slot.take(0.0)) is not None:
        yield json.loads(message.payload(JSON))


def told(client) -> list[tuple[str, list[str]]]:
    messages = [message for message in waiting(client) if message["type"] == "alarms"]
    return [
        (message["event"] and message["event"]["kind"], [alarm["code"] for alarm in message["active"]])
        for message in messages
    ]


def test_each_event_reaches_every_client_with_the_alarms_that_are_active_after_it(runner: FakeRunner):
    async def watch() -> None:
        hub = make_hub(runner)
        with (
            hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as one,
            hub.connect(THIN, rate_hz=1.0, may_watch=lambda: True) as other,
        ):
            look(runner, LOST)
            look(runner, LOST, BEAM)
            runner.alarms.acknowledge(A, [1], "A. Therapist", runner.ns)
            hub._distribute_alarms()
            expected = [("begin", [LOST]), ("begin", [BEAM, LOST]), ("acknowledged", [BEAM, LOST]), ("end", [BEAM])]
            assert told(one) == told(other) == expected

    anyio.run(watch)


def test_a_client_that_connects_late_gets_the_active_alarms_first_and_no_past_event(runner: FakeRunner):
    async def watch() -> None:
        hub = make_hub(runner)
        look(runner, LOST)
        look(runner, LOST, BEAM)
        runner.come(0)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as client:
            first, second = list(waiting(client))
            assert (first["type"], first["event"]) == ("alarms", None)
            assert [alarm["code"] for alarm in first["active"]] == [BEAM, LOST]
            assert second["type"] == "sample"
            hub._distribute_alarms()
            assert told(client) == []

    anyio.run(watch)


def test_a_client_that_connects_while_nothing_is_wrong_gets_no_message_about_alarms(runner: FakeRunner):
    async def watch() -> None:
        hub = make_hub(runner)
        look(runner)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as client:
            assert told(client) == []

    anyio.run(watch)


def test_alarms_are_sent_before_waiting_frames_and_while_missed_samples_are_resent(runner: FakeRunner):
    async def watch() -> None:
        hub = make_hub(runner)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True, buffers=True) as client:
            client.slot.offer(hub._frame(runner.come(0), None), runner.now_s)
            look(runner, LOST)
            hub._distribute_alarms()
            assert client.slot.ready.is_set()
            assert client.slot.take_alarms() is not None
            assert client.slot.take_alarms() is None

    anyio.run(watch)


def test_a_client_that_reads_nothing_keeps_the_newest_alarms_and_can_tell_what_it_lost(runner: FakeRunner):
    async def watch() -> None:
        hub = make_hub(runner)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as client:
            for _ in range(MAX_ALARMS):
                look(runner, LOST)
                runner.alarms.acknowledge(A, [alarm.number for alarm in runner.alarms.active], "A", runner.ns)
            look(runner, BEAM)
            hub._distribute_alarms()
            messages = list(waiting(client))
            assert len(messages) == MAX_ALARMS
            numbers = [message["event"]["number"] for message in messages]
            assert numbers == list(range(runner.alarms.newest_event - MAX_ALARMS + 1, runner.alarms.newest_event + 1))
            assert [alarm["code"] for alarm in messages[-1]["active"]] == [BEAM]

    anyio.run(watch)


def test_a_server_sent_event_names_its_kind_and_no_frame_to_resume_after(runner: FakeRunner):
    async def watch() -> None:
        hub = make_hub(runner)
        look(runner, LOST)
        with hub.connect(EVENTS, rate_hz=None, may_watch=lambda: True) as client:
            event = client.slot.take(0.0).payload(EVENTS).decode()
            assert event.startswith("event: alarms\ndata: {")

    anyio.run(watch)
