"""Steps of the wall clock end no log-in; an address is what a trusted proxy says, and of that the newest."""

from datetime import datetime, timedelta

import pytest

from service.access.accounts import store as store_module
from service.access.accounts.store import AccessStore
from service.access.request.addresses import ClientAddresses, plain


def scope(peer, *forwarded):
    headers = [(b"x-forwarded-for", value.encode()) for value in forwarded]
    return {"type": "http", "client": (peer, 5), "headers": headers}


def test_a_step_of_the_wall_clock_ends_no_log_in_and_opens_no_lock(database, monkeypatch):
    mine = AccessStore(database)
    before = mine.now()

    class SetAhead(datetime):
        @classmethod
        def now(cls, tz=None):
            return datetime(2030, 1, 1, tzinfo=tz)

    monkeypatch.setattr(store_module, "datetime", SetAhead)
    assert mine.wall().year == 2030
    assert mine.now() - before < timedelta(seconds=60)
    assert AccessStore(database).now().year == 2030


def test_the_steady_clock_goes_on(monkeypatch):
    clock = store_module.steady_clock()
    before = clock()
    at_ns = store_module.time.monotonic_ns() + 3_600_000_000_000
    monkeypatch.setattr(store_module.time, "monotonic_ns", lambda: at_ns)
    assert timedelta(minutes=59) < clock() - before < timedelta(minutes=61)


BEHIND = ClientAddresses(behind_proxy=True, trusted_proxies=("10.0.0.0/24", "fd00::1"))


@pytest.mark.parametrize(
    ("peer", "forwarded", "found"),
    [
        ("10.0.0.5", ["192.0.2.7"], "192.0.2.7"),
        ("10.0.0.5", ["6.6.6.6, 192.0.2.7"], "192.0.2.7"),
        ("10.0.0.5", ["6.6.6.6", "192.0.2.7, 10.0.0.9"], "192.0.2.7"),
        ("10.0.0.5", ["192.0.2.7:5678"], "192.0.2.7"),
        ("10.0.0.5", ["[2001:db8:1:2::7]:80"], "2001:db8:1:2::"),
        ("10.0.0.5", ["made up"], "unknown"),
        ("10.0.0.5", [], "10.0.0.5"),
        ("10.0.0.5", ["10.0.0.6"], "10.0.0.5"),
        ("192.0.2.1", ["6.6.6.6"], "192.0.2.1"),
        ("fd00::1", ["6.6.6.6"], "6.6.6.6"),
        ("::ffff:10.0.0.5", ["6.6.6.6"], "6.6.6.6"),
    ],
    ids=str,
)
def test_the_newest_hop_that_is_no_proxy_of_ours_is_who_asks(peer, forwarded, found):
    assert BEHIND.address(scope(peer, *forwarded)) == found


def test_without_a_proxy_forwarded_addresses_are_ignored():
    callers = ClientAddresses(behind_proxy=False, trusted_proxies=())
    assert callers.address(scope("127.0.0.1", "6.6.6.6")) == "127.0.0.1"
    assert ClientAddresses(behind_proxy=True, trusted_proxies=()).address(scope("127.0.0.1", "6.6.6.6")) == "6.6.6.6"


def test_a_network_of_one_customer_is_one_address():
    assert plain("2001:db8:1:2:a::1") == plain("2001:db8:1:2:b::2")
    assert plain("2001:db8:1:2::1") != plain("2001:db8:1:3::1")
    assert plain("::1") == "::1"
    assert plain("::ffff:192.0.2.1") == "192.0.2.1"


def test_there_is_no_address_without_a_peer():
    assert ClientAddresses(behind_proxy=False, trusted_proxies=()).address({"type": "http", "headers": []}) == "unknown"
