"""People are made and disabled, never deleted; keys are shown once, bounded, and taken back for good."""

from dataclasses import replace
from datetime import timedelta

import pytest
from starlette.datastructures import Headers

from service.access.accounts.people import Change, make_first_admin
from service.access.login.cookies import CookieScope
from service.access.login.keys import KeyService
from service.access.request.authenticator import Authenticator
from service.core.errors import BoundError, LastAdminError, NameTakenError, NotFoundError
from service.core.permissions import KEY_PERMISSIONS, Permission, Role
from service.storage.audit.log import AuditLog
from service.storage.database.tables import ApiKeyRow
from tests.support.access.login_times import IDLE
from tests.support.service.accounts import PASSWORD

pytestmark = pytest.mark.both_databases


@pytest.fixture
def keys(store):
    return KeyService(store, longest=timedelta(days=30))


@pytest.fixture
def door(store, keys, screens):
    return Authenticator(store, keys, screens, idle=IDLE, cookies=CookieScope(is_secure=False))


def rows(database, action):
    page = AuditLog(database).page(None, 500, None).items
    return [row for row in reversed(page) if row.action == action]


def bearer(secret, scheme="Bearer"):
    return Headers({"Authorization": f"{scheme} {secret}"})


def test_the_first_start_makes_an_administrator_and_no_later_one_does(store, people, hashing, database):
    reported = []
    for _ in range(2):
        make_first_admin(store, people, lambda name, password: reported.append((name, password)))
    ((name, password),) = reported
    admin = store.users["admin"]
    assert (name, admin.roles, admin.must_change_password) == ("admin", frozenset({Role.ADMIN}), True)
    assert hashing.verify(admin.password_hash, password)
    assert len(password) >= 16
    (row,) = rows(database, "user.create")
    assert row.actor == "tidegate"
    assert password not in str(row)


def test_a_person_is_made_with_a_password_to_be_changed_and_the_audit_reports_by_whom(people, database):
    issued = people.add("B. Physicist", [Role.PHYSICIST, Role.ADMIN], by="admin")
    assert issued.user.must_change_password
    assert issued.one_time_password not in repr(issued)
    (row,) = rows(database, "user.create")
    assert (row.actor, row.detail["user"], row.detail["roles"]) == ("admin", "B. Physicist", ["admin", "physicist"])


@pytest.mark.parametrize("name", ["", " a", "a/b", "key:a", "a\nb", "x" * 81, "tidegate", "Unknown", "\uff34IDEGATE"])
def test_names_that_could_be_taken_for_others_are_refused(people, name):
    with pytest.raises(BoundError, match="name must be"):
        people.add(name, [Role.VIEWER], by="admin")


def test_a_name_that_looks_like_another_is_taken_also_by_who_is_disabled(people):
    people.add("Zoë", [Role.VIEWER], by="admin")
    people.add("Else", [Role.ADMIN], by="admin")
    people.change("Zoë", Change(is_disabled=True), by="admin")
    with pytest.raises(NameTakenError):
        people.add("ZOE\u0308", [Role.VIEWER], by="admin")


def test_a_change_reports_the_audit_what_was_and_what_is(people, database):
    people.add("Else", [Role.ADMIN], by="admin")
    people.add("B. Physicist", [Role.VIEWER], by="admin")
    people.change("b. physicist", Change(roles=frozenset({Role.PHYSICIST})), by="Else")
    (row,) = rows(database, "user.change")
    assert (row.actor, row.detail["user"]) == ("Else", "B. Physicist")
    assert (row.detail["before"]["roles"], row.detail["after"]["roles"]) == (["viewer"], ["physicist"])


@pytest.mark.parametrize(
    "change", [Change(is_disabled=True), Change(roles=frozenset({Role.VIEWER}))], ids=["disabled", "demoted"]
)
def test_the_last_administrator_stays(people, change):
    people.add("only", [Role.ADMIN], by="admin")
    with pytest.raises(LastAdminError):
        people.change("only", change, by="only")
    people.add("other", [Role.ADMIN], by="admin")
    people.change("only", change, by="other")


def test_a_reset_makes_a_new_password_and_ends_the_log_ins(people, logins, hashing):
    from service.access.login.logins import Attempt

    user = people.add("B. Physicist", [Role.ADMIN], by="admin", password=PASSWORD).user
    logins.log_in(Attempt(name=user.name, password=PASSWORD, address="10.0.0.1"))
    issued = people.change(user.name, Change(reset_password=True), by="admin")
    assert hashing.verify(issued.user.password_hash, issued.one_time_password)
    assert issued.user.must_change_password
    assert logins._store.logins == {}


def test_a_person_must_have_a_role_and_an_unknown_one_is_not_changed(people):
    with pytest.raises(BoundError, match="roles must be"):
        people.add("none", [], by="admin")
    with pytest.raises(NotFoundError):
        people.change("nobody there", Change(is_disabled=True), by="admin")


def test_a_key_opens_what_its_scopes_say_until_it_is_over(keys, door, clock, database):
    made = keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=2), by="admin")
    identity = door.identify(bearer(made.secret, "bearer"))
    assert (identity.kind, identity.name) == ("key", "key:planning")
    assert identity.permissions == {Permission.SESSIONS_READ}
    clock.go_on(days=2)
    assert door.identify(bearer(made.secret)) is None
    assert not door.is_valid(identity)
    (row,) = rows(database, "key.create")
    assert (row.actor, row.detail["key"]) == ("admin", "planning")
    assert made.secret not in repr(made)


def test_a_revoked_key_opens_nothing_for_good(keys, door, clock, database):
    made = keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=2), by="admin")
    identity = door.identify(bearer(made.secret))
    first = keys.revoke(made.key.id, by="Else")
    assert keys.revoke(made.key.id, by="admin") == first
    assert door.identify(bearer(made.secret)) is None
    assert not door.is_valid(identity)
    assert [row.actor for row in rows(database, "key.revoke")] == ["Else"]


@pytest.mark.parametrize(
    "token",
    [
        "",
        "tg_",
        "tg__",
        "tg_{id}_",
        "tg_{id}",
        "{secret}x",
        "TG_{rest}",
        "tg_{id}_{id}",
        "Bearer {secret}",
        "x" * 20_000,
    ],
)
def test_nothing_like_a_key_is_one(keys, door, clock, token):
    made = keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=2), by="admin")
    tried = token.format(id=made.key.id, secret=made.secret, rest=made.secret[3:])
    assert door.identify(bearer(tried)) is None
    assert door.identify(bearer(made.secret, "Basic")) is None


def test_a_header_that_is_wrong_is_not_made_good_by_a_cookie(logins, people, door):
    from service.access.login.logins import Attempt

    people.add("B. Physicist", [Role.ADMIN], by="admin", password=PASSWORD)
    token = logins.log_in(Attempt(name="B. Physicist", password=PASSWORD, address="10.0.0.1")).token
    both = Headers({"Cookie": f"tidegate_login={token}", "Authorization": "Bearer tg_x_y"})
    assert door.identify(both) is None


@pytest.mark.parametrize("scope", [*sorted(set(Permission) - KEY_PERMISSIONS), None])
def test_what_is_for_people_no_key_has(keys, clock, scope):
    scopes = [Permission.SESSIONS_READ, scope] if scope else []
    with pytest.raises(BoundError, match="scopes must be"):
        keys.create("planning", scopes, clock() + timedelta(days=1), by="admin")


def test_a_key_that_was_stored_with_what_is_for_people_loses_it(keys, door, store, database, clock):
    made = keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=1), by="admin")
    with database.write() as db:
        db.get(ApiKeyRow, made.key.id).scopes = "gate.acknowledge qa.run sessions.read users.manage"
    store.load()
    assert keys.find_id(made.key.id).scopes == {Permission.SESSIONS_READ}
    assert door.identify(bearer(made.secret)).permissions == {Permission.SESSIONS_READ}


def test_a_key_in_memory_with_what_is_for_people_cannot_use_it(keys, door, store, clock):
    made = keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=1), by="admin")
    store.keys[made.key.id] = replace(made.key, scopes=frozenset(Permission))
    assert door.identify(bearer(made.secret)).permissions == KEY_PERMISSIONS


@pytest.mark.parametrize("days", [0, -1, 30.1])
def test_a_key_ends_and_soon_enough(keys, clock, days):
    with pytest.raises(BoundError, match="at most 30 days"):
        keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=days), by="admin")


def test_two_keys_never_have_one_name(keys, clock):
    made = keys.create("planning", [Permission.SESSIONS_READ], clock() + timedelta(days=1), by="admin")
    keys.revoke(made.key.id, by="admin")
    with pytest.raises(NameTakenError):
        keys.create("Planning", [Permission.SESSIONS_READ], clock() + timedelta(days=1), by="admin")
