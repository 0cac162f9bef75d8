"""One task sees each frame once; each form is written once, for however many watch."""

import contextlib
import json
from datetime import datetime, timedelta

import anyio
import pytest

from service.core.schemas.live_messages import Idle
from service.web.stream.encoding import FRESH_S, Plain
from service.web.stream.hub import LiveHub
from tests.support.stream.fake_runner import EVENTS, JSON, THIN, FakeRunner, make_frame, make_hub
from tests.support.waiting import PATIENCE_S


def test_two_hundred_clients_cost_one_writing_a_frame_and_form():
    async def watch():
        runner = FakeRunner()
        hub = make_hub(runner)
        with contextlib.ExitStack() as all_of_them:
            clients = [
                all_of_them.enter_context(hub.connect(shape, rate_hz=None, may_watch=lambda: True))
                for shape in (JSON, THIN, EVENTS)
                for _ in range(67)
            ]
            for index in range(5):
                runner.come(index)
                hub._distribute_newest(runner.now_s)
                for client in clients:
                    client.slot.take(runner.now_s).payload(client.slot.shape)
            assert hub.reading().encoded == 5 * 3
            assert sum(hub.reading().clients.values()) == 201

    anyio.run(watch)


def test_every_form_states_the_same():
    runner = FakeRunner()
    frame = make_frame(runner, 3)
    full = json.loads(frame.payload(JSON))
    event = frame.payload(EVENTS).decode()
    assert event.startswith(f"event: sample\nid: {'a' * 32}:3\ndata: ")
    assert event.endswith("\n\n")
    assert json.loads(event.split("data: ")[1]) == full
    thin = json.loads(frame.payload(THIN))
    assert thin.pop("latency_ms") == full["latency_ms"]["last"]
    assert thin.pop("form") == "thin"
    assert {name: full[name] for name in thin} == thin
    assert len(frame.payload(THIN)) < len(frame.payload(JSON)) / 2


def test_times_are_those_of_the_frame_and_the_age_is_that_of_the_message():
    runner = FakeRunner()
    told = json.loads(make_frame(runner, 0).payload(JSON))
    sent, received, captured = (
        datetime.fromisoformat(told[name]) for name in ("sent_at", "received_at", "captured_at")
    )
    assert told["age_ms"] == 2.0
    assert sent - received == timedelta(milliseconds=2)
    assert received - captured == timedelta(milliseconds=5)


def test_a_message_that_waited_is_written_anew_with_its_true_age():
    runner = FakeRunner()
    frame = make_frame(runner, 0)
    first = frame.payload(JSON)
    runner.now_s += FRESH_S / 2
    assert frame.payload(JSON) is first
    runner.now_s += FRESH_S
    runner.ns += 150_000_000
    assert json.loads(frame.payload(JSON))["age_ms"] == 152.0


def take_all(hub: LiveHub, runner: FakeRunner, frames) -> list[tuple[int, int, bool, bool]]:
    async def watch():
        found = []
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as client:
            for index, update in frames:
                runner.come(index, **update)
                hub._distribute_newest(runner.now_s)
                while (message := client.slot.take(runner.now_s)) is not None:
                    found.append((message.sequence, message.index, message.is_change, message.is_repeat))
        return found

    return anyio.run(watch)


def test_the_sequence_jumps_where_the_hub_did_not_see_a_frame():
    runner = FakeRunner()
    found = take_all(make_hub(runner), runner, [(0, {}), (1, {}), (4, {}), (5, {})])
    assert [sequence for sequence, *_ in found] == [0, 1, 4, 5]


def test_a_change_between_two_frames_is_a_message_of_its_own():
    runner = FakeRunner()
    frames = [(0, {}), (0, {"gate": "hold"}), (1, {}), (2, {"line_on": True}), (3, {})]
    found = take_all(make_hub(runner), runner, frames)
    assert [(index, is_change, is_repeat) for _, index, is_change, is_repeat in found] == [
        (0, True, False),
        (0, True, True),
        (1, False, False),
        (2, True, False),
        (3, False, False),
    ]
    assert [sequence for sequence, *_ in found] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "update",
    [
        {"gate": "dwell"},
        {"hold_reason": "outside_window"},
        {"line_on": True},
        {"is_armed": True},
        {"session_status": "ended"},
    ],
)
def test_these_are_changes_that_every_client_receives_of(update):
    runner = FakeRunner()
    assert take_all(make_hub(runner), runner, [(0, {}), (1, update)])[1][2]


def test_who_comes_late_gets_the_newest_and_is_reported_of_nothing_missed():
    async def watch():
        runner = FakeRunner()
        hub = make_hub(runner)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True):
            for index in (0, 1, 7):
                runner.come(index)
                hub._distribute_newest(runner.now_s)
            with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as late:
                assert late.slot.take(runner.now_s).index == 7
                assert late.slot.take(runner.now_s) is None
                assert late.slot.skipped == 0

    anyio.run(watch)


def test_a_hub_that_breaks_lets_everybody_go_and_begins_anew_with_the_next(caplog):
    async def watch():
        runner = FakeRunner()
        hub = make_hub(runner)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as client:
            runner.failure = RuntimeError("patient Miller")
            with anyio.fail_after(PATIENCE_S), client.scope:
                await anyio.sleep_forever()
            assert client.why == "failed"
        runner.failure = None
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as client:
            runner.come(0)
            with anyio.fail_after(PATIENCE_S):
                await client.slot.ready.wait()

    anyio.run(watch)
    assert "RuntimeError" in caplog.text
    assert "Miller" not in caplog.text


@pytest.mark.parametrize("why", ["stalled", "not_logged_in", "leaving"])
def test_who_has_to_go_is_let_go(why):
    async def watch():
        runner = FakeRunner()
        hub = make_hub(runner)
        may_watch = [True]
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: may_watch[0]) as client:
            if why == "stalled":
                client.slot.busy_since_s = runner.now_s
            elif why == "leaving":
                hub.shut_down()
            else:
                may_watch[0] = False
            runner.now_s += 5.0 if why == "stalled" else 1.0
            hub._check_clients(runner.now_s)
            assert client.scope.cancel_called is (why != "stalled"), "not before its time"
            runner.now_s += 0.1
            hub._check_clients(runner.now_s)
            assert client.why == why
        assert hub.reading().closed == {why: 1}

    anyio.run(watch)


def test_the_first_reason_to_let_a_client_go_is_the_one_that_is_reported():
    """Closing takes a while: the client may go by itself, and be found stalled by the checks that follow."""

    async def watch():
        runner = FakeRunner()
        hub = make_hub(runner)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: False) as client:
            client.slot.busy_since_s = runner.now_s
            runner.now_s += 1.0
            hub._check_clients(runner.now_s)
            assert client.why == "not_logged_in"
            runner.now_s += 5.0
            hub._check_clients(runner.now_s)
            client.end("gone")
        assert hub.reading().closed == {"not_logged_in": 1}

    anyio.run(watch)


def test_silence_is_broken_by_a_ping_and_only_silence():
    async def watch():
        runner = FakeRunner()
        hub = make_hub(runner)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as client:
            runner.now_s += 0.9
            hub._check_clients(runner.now_s)
            assert client.slot.take(runner.now_s) is None
            runner.now_s += 0.2
            hub._check_clients(runner.now_s)
            assert json.loads(client.slot.take(runner.now_s).payload(JSON))["type"] == "ping"

    anyio.run(watch)


def test_a_ping_does_not_take_the_place_of_a_message_that_waits():
    """On a machine that stood still both are due at once."""

    async def watch():
        runner = FakeRunner()
        hub = make_hub(runner)
        with hub.connect(JSON, rate_hz=None, may_watch=lambda: True) as client:
            hub._broadcast(Plain(Idle(sent_at=hub.clock.utc()), hub._encoder))
            runner.now_s += 2.0
            hub._check_clients(runner.now_s)
            assert json.loads(client.slot.take(runner.now_s).payload(JSON))["type"] == "idle"

    anyio.run(watch)
