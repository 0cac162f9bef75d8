"""Patient screens: one use of one code, few guesses, an end in any case; secrets are kept as hashes."""

from datetime import timedelta

import pytest
from sqlalchemy.exc import OperationalError
from starlette.datastructures import Headers

from service.access.login.cookies import CookieScope, screen_cookie_name
from service.access.login.keys import KeyService
from service.access.login.lockout import FREE_PER_ADDRESS
from service.access.request.authenticator import Authenticator
from service.access.screens.screens import CODE_LIFE, MAX_ADDRESSES, MAX_SCREENS, MAX_WRONG_CODES
from service.core.errors import LockedOutError, NotFoundError, PairingRefusedError
from service.core.permissions import Permission
from service.storage.audit.log import AuditLog
from tests.support.access.login_times import IDLE, LASTS

pytestmark = pytest.mark.both_databases
ANN = "A. Therapist"
HERE = "10.0.0.7"


@pytest.fixture
def door(store, screens):
    keys = KeyService(store, longest=timedelta(days=30))
    return Authenticator(store, keys, screens, idle=IDLE, cookies=CookieScope(is_secure=False))


def rows(database, action):
    page = AuditLog(database).page(None, 500, None).items
    return [row for row in reversed(page) if row.action == action]


def pair(screens, address=HERE):
    return screens.pair(screens.open_code(by=ANN).code, address)


def other_than(code):
    return f"{(int(code) + 1) % 1_000_000:06}"


def cookie(token):
    return Headers({"Cookie": f"{screen_cookie_name(CookieScope(is_secure=False))}={token}"})


def test_a_code_pairs_one_screen_which_may_watch_and_no_more(screens, door):
    opened = screens.open_code(by=ANN)
    paired = screens.pair(opened.code, HERE)
    identity = door.identify_watcher(cookie(paired.token))
    assert (identity.name, identity.permissions) == ("screen:1", {Permission.COACH_WATCH})
    assert not identity.is_person
    assert door.identify(cookie(paired.token)) is None
    with pytest.raises(PairingRefusedError):
        screens.pair(opened.code, HERE)


def test_a_code_expires(screens, clock):
    opened = screens.open_code(by=ANN)
    clock.go_on(seconds=CODE_LIFE.total_seconds())
    assert screens.code_expiry() is None
    with pytest.raises(PairingRefusedError):
        screens.pair(opened.code, HERE)


def test_a_new_code_takes_the_place_of_the_one_before(screens):
    first, second = screens.open_code(by=ANN), screens.open_code(by=ANN)
    with pytest.raises(PairingRefusedError):
        screens.pair(first.code if first.code != second.code else other_than(second.code), HERE)
    assert screens.pair(second.code, HERE).screen.number == 1


def test_after_five_wrong_codes_from_anywhere_the_right_one_is_refused(screens, refused_logins):
    opened = screens.open_code(by=ANN)
    for number in range(MAX_WRONG_CODES):
        with pytest.raises(PairingRefusedError):
            screens.pair(other_than(opened.code), f"10.0.0.{number}")
    with pytest.raises(PairingRefusedError):
        screens.pair(opened.code, HERE)
    (event,) = refused_logins.take_events()
    assert (event.action, event.outcome, event.actor) == ("screen.pair", "refused", ANN)
    assert refused_logins.total["pairing codes"] == MAX_WRONG_CODES + 1


def test_four_wrong_codes_leave_the_right_one_open(screens):
    opened = screens.open_code(by=ANN)
    for _ in range(MAX_WRONG_CODES - 1):
        with pytest.raises(PairingRefusedError):
            screens.pair(other_than(opened.code), HERE)
    assert screens.pair(opened.code, HERE).screen.number == 1


def test_an_address_that_guesses_waits_longer_and_longer(screens, clock):
    for _ in range(FREE_PER_ADDRESS):
        with pytest.raises(PairingRefusedError):
            screens.pair("000000", HERE)
    with pytest.raises(LockedOutError) as locked:
        screens.pair("000000", HERE)
    opened = screens.open_code(by=ANN)
    with pytest.raises(LockedOutError):
        screens.pair(opened.code, HERE)
    clock.go_on(seconds=int(locked.value.headers["Retry-After"]))
    assert screens.pair(opened.code, HERE).screen.address == HERE


def test_the_addresses_that_are_remembered_are_bounded(screens):
    for number in range(MAX_ADDRESSES + 5):
        with pytest.raises(PairingRefusedError):
            screens.pair("000000", f"address {number}")
    assert len(screens._attempts) == MAX_ADDRESSES


def test_no_secret_is_kept_or_shown_by_repr(screens):
    opened = screens.open_code(by=ANN)
    kept = repr(vars(screens))
    assert opened.code not in kept.replace(str(opened.expires_at), "")
    assert opened.code not in repr(opened)
    paired = screens.pair(opened.code, HERE)
    assert paired.token not in repr(vars(screens))
    assert paired.token not in repr(paired)


def test_a_pairing_ends_at_its_time_though_it_is_watched_all_along(screens, door, clock):
    token = pair(screens).token
    identity = door.identify_watcher(cookie(token))
    step = IDLE / 2
    for _ in range(int(LASTS / step) - 1):
        clock.go_on(seconds=step.total_seconds())
        assert door.is_valid(identity)
    clock.go_on(seconds=step.total_seconds())
    assert not door.is_valid(identity)
    assert door.identify_watcher(cookie(token)) is None
    assert screens.all() == []


def test_a_screen_that_does_not_watch_is_not_paired_any_more(screens, door, clock):
    token = pair(screens).token
    clock.go_on(seconds=IDLE.total_seconds() + 1)
    assert door.identify_watcher(cookie(token)) is None
    assert screens.all() == []


def test_an_ended_screen_is_out_at_once_and_the_audit_has_who_did_it(screens, door, database):
    paired = pair(screens)
    identity = door.identify_watcher(cookie(paired.token))
    screens.end(paired.screen.id, by="B. Physicist")
    assert not door.is_valid(identity)
    with pytest.raises(NotFoundError):
        screens.end(paired.screen.id, by="B. Physicist")
    assert [row.actor for row in rows(database, "screen.end")] == ["B. Physicist"]


def test_every_code_and_pairing_is_audited_without_the_secret(screens, database):
    opened = screens.open_code(by=ANN)
    token = screens.pair(opened.code, HERE).token
    found = [*rows(database, "screen.code"), *rows(database, "screen.pair")]
    assert [row.actor for row in found] == [ANN, ANN]
    assert found[1].detail["address"] == HERE
    assert token not in repr(found)
    assert f"'{opened.code}'" not in repr(found)


def test_what_the_audit_does_not_take_is_not_done(screens, store, monkeypatch):
    def fail(**_given):
        raise OperationalError("", None, Exception())

    opened = screens.open_code(by=ANN)
    paired = pair(screens)
    opened = screens.open_code(by=ANN)
    monkeypatch.setattr(store, "write", fail)
    for action in (
        lambda: screens.pair(opened.code, HERE),
        lambda: screens.end(paired.screen.id, by=ANN),
        lambda: screens.open_code(by=ANN),
    ):
        with pytest.raises(OperationalError):
            action()
    assert [one.number for one, _ in screens.all()] == [1]


def test_one_screen_too_many_ends_the_oldest(screens, door):
    tokens = [pair(screens).token for _ in range(MAX_SCREENS + 1)]
    assert [one.number for one, _ in screens.all()] == [2, 3, 4, 5]
    assert door.identify_watcher(cookie(tokens[0])) is None


def test_a_log_in_in_the_same_browser_watches_where_no_screen_is_paired(screens, door, people, logins):
    from service.access.login.logins import Attempt
    from service.core.permissions import Role
    from tests.support.service.accounts import PASSWORD

    people.add(ANN, [Role.THERAPIST], by="test", password=PASSWORD)
    login = logins.log_in(Attempt(name=ANN, password=PASSWORD, address=HERE)).token
    paired = pair(screens)
    both = Headers(
        {"Cookie": f"tidegate_login={login}; {screen_cookie_name(CookieScope(is_secure=False))}={paired.token}"}
    )
    assert door.identify_watcher(both).kind == "screen"
    assert door.identify(both).kind == "user"
    screens.end(paired.screen.id, by=ANN)
    assert door.identify_watcher(both).name == ANN
