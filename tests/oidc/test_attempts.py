"""A log-in that has set out comes back once, in time, to the browser that began it."""

import pytest

from engine.clock import NS_PER_S, ManualClock
from service.access import oidc_attempts
from service.access.oidc_attempts import LIFE_S, MOST_AN_ADDRESS, MOST_FAILURES, AttemptShelf, FailureBrake
from service.access.oidc_errors import OidcRefusedError


@pytest.fixture
def clock():
    return ManualClock(7 * NS_PER_S)


@pytest.fixture
def shelf(clock):
    return AttemptShelf(clock)


def is_there(shelf: AttemptShelf, begun) -> bool:
    attempt, browser = begun
    try:
        return shelf.take(attempt.state, browser) == attempt
    except OidcRefusedError:
        return False


def test_it_comes_back_once(shelf):
    begun = shelf.begin("a")
    assert is_there(shelf, begun)
    assert not is_there(shelf, begun)


def test_it_comes_back_within_five_minutes(shelf, clock):
    in_time, late = shelf.begin("a"), shelf.begin("a")
    clock.advance_ns(int(LIFE_S) * NS_PER_S)
    assert is_there(shelf, in_time)
    clock.advance_ns(1)
    assert not is_there(shelf, late)


@pytest.mark.parametrize("other", [None, "", "guessed", "é"])
def test_another_browser_cannot_bring_it_back_and_has_used_it_up(shelf, other):
    attempt, browser = shelf.begin("a")
    assert not is_there(shelf, (attempt, other))
    assert not is_there(shelf, (attempt, browser))


def test_a_browser_brings_back_only_its_own(shelf):
    mine, theirs = shelf.begin("a"), shelf.begin("b")
    assert not is_there(shelf, (mine[0], theirs[1]))


def test_no_two_are_alike_and_none_can_be_guessed(shelf):
    begun = [shelf.begin("a")[0] for _ in range(3)]
    values = [value for one in begun for value in (one.state, one.nonce, one.verifier)]
    assert len(set(values)) == len(values)
    assert all(len(value) >= 43 for value in values)  # 256 bits; and a verifier's shortest by RFC 7636


def test_a_flood_from_one_address_drops_its_own(shelf):
    mine = shelf.begin("me")
    flood = [shelf.begin("flood") for _ in range(MOST_AN_ADDRESS + 1)]
    assert not is_there(shelf, flood[0])
    assert is_there(shelf, flood[1])
    assert is_there(shelf, mine)


def test_a_flood_from_everywhere_is_bounded(shelf, monkeypatch):
    monkeypatch.setattr(oidc_attempts, "MOST", 100)
    first = shelf.begin("0")
    for number in range(1, 101):
        shelf.begin(str(number))
    assert len(shelf._attempts) == 100
    assert not is_there(shelf, first)


def test_old_ones_make_room_by_themselves(shelf, clock):
    for number in range(10):
        shelf.begin(str(number))
    clock.advance_ns(int(LIFE_S) * NS_PER_S + 1)
    shelf.begin("new")
    assert len(shelf._attempts) == 1


def test_an_address_that_brings_one_wrong_code_after_the_other_has_to_wait_and_no_other_has(clock):
    brake = FailureBrake(clock)
    for _ in range(MOST_FAILURES):
        assert not brake.is_on("flood")
        brake.note("flood")
    assert brake.is_on("flood")
    assert not brake.is_on("me")
    clock.advance_ns(int(LIFE_S) * NS_PER_S)
    assert brake.is_on("flood")
    clock.advance_ns(1)
    assert not brake.is_on("flood")


def test_failures_from_everywhere_take_no_more_room_than_that(clock, monkeypatch):
    monkeypatch.setattr(oidc_attempts, "MOST", 10)
    brake = FailureBrake(clock)
    for number in range(100):
        brake.note(str(number))
    assert len(brake._failures) == 10
