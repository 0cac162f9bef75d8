"""The coaching stream's hub: the newest for everybody, nothing of an old frame, and an end for who may not watch."""

import asyncio
from types import SimpleNamespace

import pytest

from engine.gating.windows import HoldStage
from service.core.schemas.coaching import CoachGuide, CoachWait
from service.sessions.coaching.board import CoachingBoard
from service.web.stream.coach_hub import MAX_CLIENTS, WAIT_S, CoachHub
from service.web.stream.hub import CLIENT_CHECK_S, LOGIN_CHECK_S
from tests.support.service.guided_patient import GuidedPatient


class Feed:
    """The runner, as far as the hub reads it; time is the test's."""

    def __init__(self) -> None:
        self.live = None
        self.now_s = 100.0
        self.ns = 0
        self.failure = None

    def newest(self):
        if self.failure is not None:
            raise self.failure
        return self.live

    def running_camera(self):
        return None

    def now_ns(self):
        return self.ns


@pytest.fixture
def feed() -> Feed:
    return Feed()


@pytest.fixture
def patient() -> GuidedPatient:
    return GuidedPatient()


@pytest.fixture
def hub(feed, patient) -> CoachHub:
    board = CoachingBoard(running=lambda _id: SimpleNamespace(engine=patient.running), log=None)
    return CoachHub(feed, board, stall_s=2.0, now_s=lambda: feed.now_s)


def with_client(hub, act, *, may_watch=lambda: True):
    """Run ``act(client)`` while a client is connected."""

    async def run():
        with hub.connect(may_watch) as client:
            return await act(client)

    return asyncio.run(asyncio.wait_for(run(), 20.0))


async def message_of(hub, client):
    return hub.message(await client.take())


def test_a_frame_s_guidance_comes_with_the_age_it_has_when_it_is_sent(hub, feed, patient):
    async def act(client):
        feed.live = patient.frame(16.0, HoldStage.HELD)
        frame = await client.take()
        while frame.guidance is None:
            frame = await client.take()
        feed.ns = feed.live.received_ns + 42_000_000
        return hub.message(frame)

    found = with_client(hub, act)
    assert isinstance(found, CoachGuide)
    assert (found.age_ms, found.instruction) == (42.0, "hold")


def test_who_does_not_keep_up_gets_the_newest_and_none_before(hub, feed, patient):
    async def act(client):
        first = await client.take()
        for index in range(30):
            feed.live = patient.frame(float(index) / 10, HoldStage.AWAITED)
            hub._distribute(feed.now_s)
        return first, await client.take(), client.newest

    first, newest, further = with_client(hub, act)
    assert newest.received_ns == feed.live.received_ns
    assert newest.sequence >= first.sequence + 30
    assert further is None


def test_between_frames_nothing_is_sent_so_that_a_screen_goes_black_by_itself(hub, feed, patient):
    async def act(client):
        feed.live = patient.frame(16.0, HoldStage.HELD)
        while (await client.take()).guidance is None:
            pass
        for _ in range(20):
            feed.now_s += WAIT_S
            await asyncio.sleep(0.005)
        return client.newest

    assert with_client(hub, act) is None


def test_while_nothing_is_shown_a_wait_comes_ten_times_a_second(hub, feed):
    async def act(client):
        found = [await message_of(hub, client)]
        for _ in range(3):
            feed.now_s += WAIT_S
            found.append(await message_of(hub, client))
        return found

    found = with_client(hub, act)
    assert {type(one) for one in found} == {CoachWait}
    assert [one.sequence for one in found] == [1, 2, 3, 4]


def test_the_end_of_the_session_is_a_wait(hub, feed, patient):
    async def act(client):
        feed.live = patient.frame(16.0, HoldStage.HELD)
        while (await client.take()).guidance is None:
            pass
        feed.live = None
        feed.now_s += WAIT_S
        return await message_of(hub, client)

    assert isinstance(with_client(hub, act), CoachWait)


@pytest.mark.parametrize(
    ("why", "elapsed_s"), [("not_logged_in", LOGIN_CHECK_S), ("stalled", 2.1), ("leaving", CLIENT_CHECK_S)]
)
def test_a_client_is_let_go_for_a_reason(hub, feed, why, elapsed_s):
    async def act(client):
        if why == "stalled":
            client.busy_since_s = feed.now_s
        if why == "leaving":
            hub.shut_down()
        hub._check_clients(feed.now_s + elapsed_s)
        return client.why

    assert with_client(hub, act, may_watch=lambda: why != "not_logged_in") == why


def test_a_hub_that_fails_lets_its_clients_go_and_starts_again(hub, feed, patient):
    async def failing(client):
        await client.take()
        feed.failure = ValueError("a bug")
        with pytest.raises(ValueError, match="a bug"):
            await hub._task
        return client.why

    async def working(client):
        return await client.take()

    assert with_client(hub, failing) == "failed"
    feed.failure, feed.live = None, patient.frame(16.0, HoldStage.HELD)
    assert with_client(hub, working).guidance is not None


def test_there_are_no_more_clients_than_the_hub_serves(hub):
    async def run():
        entered = [hub.connect(lambda: True) for _ in range(MAX_CLIENTS)]
        for one in entered:
            assert one.__enter__() is not None
        with hub.connect(lambda: True) as surplus:
            found = surplus
        for one in entered:
            one.__exit__(None, None, None)
        return found

    assert asyncio.run(run()) is None
    assert hub.client_count == 0
