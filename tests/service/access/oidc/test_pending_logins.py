"""A log-in that has set out comes back once, in time, to the browser that began it."""

import pytest

from engine.core.clock import NS_PER_S, ManualClock
from service.access.oidc import pending_logins
from service.access.oidc.pending_logins import LIFE_S, MAX_FAILURES, MAX_PER_ADDRESS, FailureLimiter, PendingLogins
from service.access.oidc.refusals import OidcRefusedError


@pytest.fixture
def clock():
    return ManualClock(7 * NS_PER_S)


@pytest.fixture
def pending(clock):
    return PendingLogins(clock)


def is_there(pending: PendingLogins, begun) -> bool:
    attempt, browser = begun
    try:
        return pending.take(attempt.state, browser) == attempt
    except OidcRefusedError:
        return False


def test_it_comes_back_once(pending):
    begun = pending.begin("a")
    assert is_there(pending, begun)
    assert not is_there(pending, begun)


def test_it_comes_back_within_five_minutes(pending, clock):
    in_time, late = pending.begin("a"), pending.begin("a")
    clock.advance_ns(int(LIFE_S) * NS_PER_S)
    assert is_there(pending, in_time)
    clock.advance_ns(1)
    assert not is_there(pending, late)


@pytest.mark.parametrize("other", [None, "", "guessed", "é"])
def test_another_browser_cannot_bring_it_back_and_has_used_it_up(pending, other):
    attempt, browser = pending.begin("a")
    assert not is_there(pending, (attempt, other))
    assert not is_there(pending, (attempt, browser))


def test_a_browser_brings_back_only_its_own(pending):
    mine, theirs = pending.begin("a"), pending.begin("b")
    assert not is_there(pending, (mine[0], theirs[1]))


def test_no_two_are_alike_and_none_can_be_guessed(pending):
    begun = [pending.begin("a")[0] for _ in range(3)]
    values = [value for one in begun for value in (one.state, one.nonce, one.verifier)]
    assert len(set(values)) == len(values)
    assert all(len(value) >= 43 for value in values)  # 256 bits; and a verifier's shortest by RFC 7636


def test_a_flood_from_one_address_drops_its_own(pending):
    mine = pending.begin("me")
    flood = [pending.begin("flood") for _ in range(MAX_PER_ADDRESS + 1)]
    assert not is_there(pending, flood[0])
    assert is_there(pending, flood[1])
    assert is_there(pending, mine)


def test_a_flood_from_everywhere_is_bounded(pending, monkeypatch):
    monkeypatch.setattr(pending_logins, "MAX_PENDING", 100)
    first = pending.begin("0")
    for number in range(1, 101):
        pending.begin(str(number))
    assert len(pending._attempts) == 100
    assert not is_there(pending, first)


def test_old_ones_make_room_by_themselves(pending, clock):
    for number in range(10):
        pending.begin(str(number))
    clock.advance_ns(int(LIFE_S) * NS_PER_S + 1)
    pending.begin("new")
    assert len(pending._attempts) == 1


def test_an_address_that_brings_one_wrong_code_after_the_other_has_to_wait_and_no_other_has(clock):
    limiter = FailureLimiter(clock)
    for _ in range(MAX_FAILURES):
        assert not limiter.is_limited("flood")
        limiter.record("flood")
    assert limiter.is_limited("flood")
    assert not limiter.is_limited("me")
    clock.advance_ns(int(LIFE_S) * NS_PER_S)
    assert limiter.is_limited("flood")
    clock.advance_ns(1)
    assert not limiter.is_limited("flood")


def test_failures_from_everywhere_take_no_more_room_than_that(clock, monkeypatch):
    monkeypatch.setattr(pending_logins, "MAX_PENDING", 10)
    limiter = FailureLimiter(clock)
    for number in range(100):
        limiter.record(str(number))
    assert len(limiter._failures) == 10
