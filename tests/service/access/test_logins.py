"""Log-ins: one answer for whatever is wrong, a wait that grows, tokens that no one can use twice or guess."""

from dataclasses import replace
from datetime import timedelta

import pytest
from sqlalchemy.exc import OperationalError
from starlette.datastructures import Headers

from service.access.accounts.people import Change
from service.access.accounts.store import AccessStore
from service.access.login.cookies import PLAIN_NAME, CookieScope
from service.access.login.keys import KeyService
from service.access.login.lockout import FREE_PER_ADDRESS, FREE_PER_NAME, MAX_SUBJECTS, MAX_WAIT, failed_again
from service.access.login.logins import MAX_LOGINS, Attempt, hashed
from service.access.request.authenticator import Authenticator
from service.access.service import AccessCleanupWorker
from service.core.errors import LockedOutError, LoginFailedError, NotFoundError, WrongPasswordError
from service.core.permissions import Permission, Role
from service.storage.audit.log import AuditLog
from tests.support.access.login_times import IDLE, LASTS
from tests.support.service.accounts import PASSWORD

pytestmark = pytest.mark.both_databases
NAME = "A. Therapist"


@pytest.fixture
def person(people):
    return people.add(NAME, [Role.THERAPIST], by="test", password=PASSWORD).user


@pytest.fixture
def keys(store):
    return KeyService(store, longest=timedelta(days=30))


@pytest.fixture
def door(store, keys, screens):
    return Authenticator(store, keys, screens, idle=IDLE, cookies=CookieScope(is_secure=False))


def attempt(name=NAME, password=PASSWORD, address="10.0.0.1", **more):
    return Attempt(name=name, password=password, address=address, **more)


def sent(token):
    return Headers({"Cookie": f"other=1; {PLAIN_NAME}={token}"})


def fail(logins, times, **who):
    for _ in range(times):
        with pytest.raises(LoginFailedError):
            logins.log_in(attempt(password="wrong", **who))


def rows(database, action):
    page = AuditLog(database).page(None, 500, None).items
    return [row for row in reversed(page) if row.action == action]


def test_a_name_and_its_password_open_a_log_in(logins, door, person, database):
    opened = logins.log_in(attempt())
    identity = door.identify(sent(opened.token))
    assert (identity.name, identity.kind) == (NAME, "user")
    assert Permission.GATE_ARM in identity.permissions
    (row,) = rows(database, "user.login")
    assert (row.actor, row.outcome, row.detail["way"], row.detail["address"]) == (NAME, "done", "password", "10.0.0.1")
    assert opened.token not in str(row)
    assert opened.token not in repr(opened)


def test_names_are_the_same_whatever_their_case_or_width(logins, person):
    assert logins.log_in(attempt(name="\uff41. therapist ")).user == logins._store.users[person.key]


def test_nothing_reports_whether_a_name_is_known_the_password_is_checked_once_either_way(
    logins, hashing, people, person, store
):
    people.add("Disabled", [Role.VIEWER], by="test", password=PASSWORD)
    people.add("Else", [Role.ADMIN], by="test", password=PASSWORD)
    people.change("Disabled", Change(is_disabled=True), by="test")
    outside = replace(person, name="Outside", password_hash=None, issuer="i", subject="s")
    store.write(save=[outside])
    said = set()
    for number, tried in enumerate(
        [attempt(password="wrong"), attempt(name="Nobody"), attempt(name="Disabled"), attempt(name="Outside")]
    ):
        before = len(hashing.verified)
        with pytest.raises(LoginFailedError) as refused:
            logins.log_in(replace(tried, address=f"10.0.1.{number}"))
        assert len(hashing.verified) == before + 1
        said.add((str(refused.value), refused.value.code, str(refused.value.headers)))
    assert len(said) == 1


def test_known_and_unknown_names_are_locked_after_the_same_number_of_failures_for_the_same_time(logins, person):
    waits = []
    for number, name in enumerate((NAME, "Nobody at all")):
        fail(logins, FREE_PER_NAME, name=name, address=f"10.0.2.{number}")
        with pytest.raises(LockedOutError) as locked:
            logins.log_in(attempt(name=name, address=f"10.0.3.{number}"))
        waits.append(locked.value.headers["Retry-After"])
    assert waits == ["1", "1"]


def test_each_failure_doubles_the_wait_up_to_a_quarter_of_an_hour_and_the_right_password_does_not_help(
    logins, person, clock, hashing
):
    fail(logins, FREE_PER_NAME)
    waits = []
    for number in range(14):
        with pytest.raises(LockedOutError) as locked:
            logins.refuse_locked(NAME, f"10.9.0.{number}")
        waits.append(int(locked.value.headers["Retry-After"]))
        asked = len(hashing.verified)
        with pytest.raises(LockedOutError):
            logins.log_in(attempt(address=f"10.9.0.{number}"))
        assert len(hashing.verified) == asked
        clock.go_on(seconds=waits[-1])
        fail(logins, 1, address=f"10.9.1.{number}")
    assert waits == [1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 900, 900, 900, 900]


def test_who_has_waited_logs_in_and_is_forgiven(logins, person, clock, store):
    fail(logins, FREE_PER_NAME)
    clock.go_on(seconds=1)
    logins.log_in(attempt())
    assert not [subject for subject in store.attempts if subject.startswith("name ")]


def test_an_address_is_locked_whatever_names_it_tries_and_others_are_not(logins, person):
    for number in range(FREE_PER_ADDRESS):
        fail(logins, 1, name=f"name {number}")
    with pytest.raises(LockedOutError):
        logins.log_in(attempt())
    assert logins.log_in(attempt(address="10.0.0.2")).user.name == NAME


def test_a_lock_survives_a_restart(logins, person, database, clock, hashing, refused_logins):
    fail(logins, FREE_PER_NAME)
    again = AccessStore(database, clock)
    again.load()
    assert again.attempts == logins._store.attempts
    assert (again.users, again.logins, again.keys) == (logins._store.users, logins._store.logins, logins._store.keys)


def test_a_wall_clock_that_was_set_back_extends_no_lock_beyond_the_longest(logins, person, clock):
    fail(logins, FREE_PER_NAME)
    clock.go_on(days=-300)
    with pytest.raises(LockedOutError) as locked:
        logins.log_in(attempt())
    assert int(locked.value.headers["Retry-After"]) <= MAX_WAIT.total_seconds()


def test_what_failed_an_hour_ago_counts_no_more_and_is_swept_away(logins, person, clock, store, refused_logins):
    fail(logins, FREE_PER_NAME - 1)
    clock.go_on(hours=1, seconds=1)
    fail(logins, 1)
    assert logins.log_in(attempt()).user.name == NAME
    clock.go_on(hours=2)
    AccessCleanupWorker(store, refused_logins, lambda _event: None, idle=IDLE).delete_expired()
    assert store.attempts == {}


def test_made_up_names_cannot_fill_the_memory_and_do_not_push_out_who_is_locked(logins, person, store, clock):
    fail(logins, FREE_PER_NAME)
    for number in range(MAX_SUBJECTS):
        subject = f"name made up {number}"
        store.attempts[subject] = failed_again(None, subject, clock())
    fail(logins, 1, name="one more", address="10.3.3.3")
    assert len(store.attempts) == MAX_SUBJECTS
    assert store.attempts["name a. therapist"].locked_until is not None


def test_a_failure_counts_although_the_database_does_not_take_it(logins, person, store, monkeypatch):
    def broken():
        raise OperationalError("down", None, Exception())

    monkeypatch.setattr(store._database, "write", broken)
    for _ in range(FREE_PER_NAME):
        with pytest.raises(OperationalError):
            logins.log_in(attempt(password="wrong"))
    with pytest.raises(LockedOutError):
        logins.log_in(attempt())


def test_a_log_in_that_the_database_did_not_store_grants_no_access(logins, person, store, monkeypatch):
    def broken():
        raise OperationalError("down", None, Exception())

    with monkeypatch.context() as patched:
        patched.setattr(store._database, "write", broken)
        with pytest.raises(OperationalError):
            logins.log_in(attempt())
    assert store.logins == {}
    assert store.users[person.key] == person


def test_a_log_in_ends_at_its_longest_lifetime_and_when_idle(logins, door, person, clock):
    used, idle = logins.log_in(attempt()), logins.log_in(attempt())
    while clock() < used.login.created_at + LASTS - IDLE / 2:
        assert door.identify(sent(used.token)) is not None
        clock.go_on(seconds=IDLE.total_seconds() / 2)
    assert door.identify(sent(idle.token)) is None
    assert door.identify(sent(used.token)) is not None
    clock.go_on(seconds=IDLE.total_seconds() / 2)
    assert door.identify(sent(used.token)) is None


def test_what_is_over_is_swept_away_and_when_the_rest_was_used_is_kept(
    logins, door, person, clock, store, refused_logins, database, keys
):
    over, used = logins.log_in(attempt()), logins.log_in(attempt())
    key = keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=1), by=NAME)
    clock.go_on(minutes=20)
    assert door.identify(sent(used.token)) is not None
    assert door.identify(Headers({"Authorization": f"Bearer {key.secret}"})) is not None
    clock.go_on(minutes=20)
    AccessCleanupWorker(store, refused_logins, lambda _event: None, idle=IDLE).delete_expired()
    again = AccessStore(database, clock)
    again.load()
    assert set(again.logins) == {used.login.key}
    assert over.login.key not in store.logins
    assert again.logins[used.login.key].seen_at == clock() - timedelta(minutes=20)
    assert again.keys[key.key.id].last_used_at == clock() - timedelta(minutes=20)


def test_each_log_in_has_a_token_of_its_own_and_the_browser_s_former_one_is_over(logins, door, person):
    first = logins.log_in(attempt())
    second = logins.log_in(attempt(former_token=first.token))
    assert first.token != second.token
    assert len(second.token) >= 43
    assert door.identify(sent(first.token)) is None
    assert door.identify(sent(second.token)) is not None


def test_a_token_that_somebody_else_chose_opens_nothing(logins, door, person, store):
    opened = logins.log_in(attempt(former_token="fixed"))
    assert hashed("fixed") not in store.logins
    assert opened.token != "fixed"


def test_the_database_has_no_token_no_password_and_no_secret(logins, person, keys, clock, database):
    opened = logins.log_in(attempt())
    made = keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=1), by=NAME)
    with database.read() as db:
        connection = db.connection()
        everything = "".join(
            str(row)
            for table in ("users", "logins", "api_keys", "failed_logins", "audit")
            for row in connection.exec_driver_sql(f"SELECT * FROM {table}")
        )
    assert opened.token not in everything
    assert made.secret.split("_", 2)[2] not in everything


def test_a_person_has_a_bounded_number_of_log_ins_the_oldest_go(logins, door, person, clock):
    opened = []
    for _ in range(MAX_LOGINS + 2):
        opened.append(logins.log_in(attempt()))
        clock.go_on(seconds=1)
    assert [door.identify(sent(one.token)) is None for one in opened] == [True, True] + [False] * MAX_LOGINS


def test_logging_out_ends_this_log_in_and_no_other(logins, door, person, database):
    here, there = logins.log_in(attempt()), logins.log_in(attempt())
    logins.log_out(here.login)
    assert door.identify(sent(here.token)) is None
    assert door.identify(sent(there.token)) is not None
    assert rows(database, "user.logout")[-1].actor == NAME


def test_a_new_password_ends_the_other_log_ins_and_the_old_one_opens_nothing(logins, door, person, database):
    here, there = logins.log_in(attempt()), logins.log_in(attempt())
    logins.change_password(person, PASSWORD, "quite another one", address="10.0.0.1", keep=here.login)
    assert door.identify(sent(here.token)) is not None
    assert door.identify(sent(there.token)) is None
    fail(logins, 1)
    logins.log_in(attempt(password="quite another one"))
    (row,) = rows(database, "user.password")
    assert "another" not in str(row)


@pytest.mark.parametrize("new", ["short", "x" * 257, NAME, PASSWORD], ids=["short", "long", "name", "same"])
def test_a_new_password_is_long_and_another(logins, people, person, new):
    named = people.add("a name long enough", [Role.VIEWER], by="test", password=PASSWORD).user
    asked = named.name if new == NAME else new
    with pytest.raises((WrongPasswordError, Exception), match="password"):
        logins.change_password(named, PASSWORD, asked, address="10.0.0.1", keep=None)
    assert logins.log_in(attempt(name=named.name)).user.name == named.name


def test_guessing_the_old_password_is_locked_as_guessing_at_the_door_is(logins, person):
    for _ in range(FREE_PER_NAME):
        with pytest.raises(WrongPasswordError):
            logins.change_password(person, "a guess", "quite another one", address="10.0.0.1", keep=None)
    with pytest.raises(LockedOutError):
        logins.change_password(person, PASSWORD, "quite another one", address="10.0.0.1", keep=None)


def test_disabling_somebody_ends_what_they_have_open_at_once(logins, door, people, person):
    people.add("Else", [Role.ADMIN], by="test", password=PASSWORD)
    opened = logins.log_in(attempt())
    identity = door.identify(sent(opened.token))
    people.change(NAME, Change(is_disabled=True), by="Else")
    assert door.identify(sent(opened.token)) is None
    assert not door.is_valid(identity)
    people.change(NAME, Change(is_disabled=False), by="Else")
    assert door.identify(sent(opened.token)) is None


def test_roles_that_are_taken_end_a_stream_that_they_opened(logins, door, people, person):
    people.add("Else", [Role.ADMIN], by="test", password=PASSWORD)
    identity = door.identify(sent(logins.log_in(attempt()).token))
    assert door.is_valid(identity)
    people.change(NAME, Change(roles=frozenset({Role.VIEWER})), by="Else")
    assert not door.is_valid(identity)


def test_somebody_outside_is_who_the_provider_states_and_has_the_roles_of_today(logins, door, person, store):
    who = {"issuer": "https://id.example", "subject": "42", "address": "10.0.0.1", "name_if_taken": f"{NAME} [42]"}
    first = logins.open_oidc(**who, name=NAME, roles=frozenset({Role.PHYSICIST}))
    assert first.user.name == f"{NAME} [42]"
    assert door.identify(sent(first.token)).kind == "oidc"
    second = logins.open_oidc(**who, name="Renamed", roles=frozenset({Role.VIEWER}))
    assert (second.user.name, second.user.roles) == (first.user.name, frozenset({Role.VIEWER}))
    store.write(save=[replace(second.user, is_disabled=True)])
    with pytest.raises(LoginFailedError):
        logins.open_oidc(**who, name=NAME, roles=frozenset(Role))


def test_a_log_in_that_is_not_one_s_own_is_not_found(logins, people, person):
    other = people.add("Else", [Role.ADMIN], by="test", password=PASSWORD).user
    opened = logins.log_in(attempt())
    with pytest.raises(NotFoundError):
        logins.find(other, opened.login.id)
