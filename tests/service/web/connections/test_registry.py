"""Connection slots are assigned and replaced by the documented order, and counts are reported periodically."""

import asyncio
import logging

import pytest

from service.core.settings.groups import ConnectionLimits
from service.web.connections import registry as registry_module
from service.web.connections.refusals import LOG_PERIOD_S, RefusalCount
from service.web.connections.registry import CHECK_PERIOD_S, ConnectionRegistry

pytestmark = pytest.mark.anyio


class Guest:
    """A connection that waits for a request, or has one under way."""

    def __init__(self, *, waits: bool = True, is_authenticated: bool = False) -> None:
        self.waits = waits
        self.is_authenticated = is_authenticated
        self.is_gone = False
        self.was_checked = False

    def check(self, _now_s):
        self.was_checked = True

    def abort(self):
        self.is_gone = True


@pytest.fixture
def anyio_backend():
    return "asyncio"


def registry(most: int = 6, each: int = 3, proxies=()) -> ConnectionRegistry:
    return ConnectionRegistry(
        ConnectionLimits(max_connections=most, max_connections_per_address=each), trusted_proxies=proxies
    )


def add(connections: ConnectionRegistry, address: str, **kind: bool) -> tuple[Guest, bool]:
    guest = Guest(**kind)
    return guest, connections.add(guest, guest, address)


@pytest.mark.parametrize("host", ["192.0.2.1", "2001:db8::{}"])  # a network of IPv6 counts as one address
async def test_beyond_its_places_an_address_s_longest_waiting_goes_for_its_newest(host):
    connections = registry()
    guests = [add(connections, host.format(i))[0] for i in range(1, 6)]
    assert [guest.is_gone for guest in guests] == [True, True, False, False, False]
    assert len(connections) == 3


async def test_one_that_is_in_use_is_never_closed_for_another():
    connections = registry()
    busy = [add(connections, "192.0.2.1", waits=False)[0] for _ in range(3)]
    assert add(connections, "192.0.2.1")[1] is False
    assert not any(guest.is_gone for guest in busy)
    assert add(connections, "192.0.2.2")[1] is True


async def test_when_all_places_are_taken_the_address_with_most_gives_one_up():
    connections = registry()
    crowd = [add(connections, "192.0.2.1")[0] for _ in range(3)]
    few = [add(connections, f"192.0.2.{i}")[0] for i in (2, 3, 4)]
    guest, is_in = add(connections, "192.0.2.9")
    assert is_in
    assert not guest.is_gone
    assert [one.is_gone for one in crowd] == [True, False, False]
    assert not any(one.is_gone for one in few)
    assert len(connections) == 6


async def test_a_known_caller_is_closed_only_if_no_unknown_one_is_connected():
    connections = registry()
    known = [add(connections, "192.0.2.1", is_authenticated=True)[0] for _ in range(3)]
    unknown = [add(connections, f"192.0.2.{i}")[0] for i in (2, 3, 4)]
    for i in (5, 6, 7):
        add(connections, f"192.0.2.{i}", waits=False)
    assert [one.is_gone for one in unknown] == [True] * 3
    assert not any(one.is_gone for one in known)
    assert add(connections, "192.0.2.8", waits=False)[1]
    assert [one.is_gone for one in known] == [True, False, False]


async def test_who_stirs_is_the_last_to_go():
    connections = registry()
    guests = [add(connections, "192.0.2.1")[0] for _ in range(3)]
    connections.note_waiting(guests[0])
    add(connections, "192.0.2.1")
    assert [guest.is_gone for guest in guests] == [False, True, False]
    connections.note_waiting(guests[1])  # who is gone stirs no more
    assert len(connections) == 3


async def test_a_proxy_that_is_trusted_may_have_as_many_as_there_are():
    connections = registry(proxies=("10.0.0.0/8",))
    proxied = [add(connections, "10.1.2.3")[0] for _ in range(6)]
    assert not any(guest.is_gone for guest in proxied)


async def test_who_left_makes_room_and_may_leave_twice():
    connections = registry()
    guests = [add(connections, "192.0.2.1")[0] for _ in range(3)]
    for guest in guests[:1] * 2:
        connections.remove(guest)
    add(connections, "192.0.2.1")
    assert not any(guest.is_gone for guest in guests[1:])
    assert len(connections) == 3


def test_refusals_are_reported_at_once_and_then_together(caplog):
    now_s = 100.0
    count = RefusalCount(lambda: now_s)
    with caplog.at_level(logging.WARNING):
        for _ in range(50):
            count.add("bad_request")
        assert len(caplog.messages) == 1
        now_s += LOG_PERIOD_S
        count.log_counts()
        count.log_counts()
    assert caplog.messages == ["connections refused: 1 bad_request", "connections refused: 49 bad_request"]
    assert count.total["bad_request"] == 50


async def test_a_client_gets_the_time_for_which_the_server_stood_still(monkeypatch):
    connections = registry()
    guest, _ = add(connections, "192.0.2.1")
    for stood_still_s, is_checked in ((7.0, False), (0.0, True)):
        now_s = connections._next_check.when() + stood_still_s
        monkeypatch.setattr(registry_module, "_loop_time", lambda now_s=now_s: now_s)
        connections._check_all()
        assert guest.was_checked is is_checked
        rest_s = connections._next_check.when() - asyncio.get_running_loop().time()
        assert rest_s == pytest.approx(stood_still_s or CHECK_PERIOD_S, abs=0.5)
