"""Every path and method of the OpenAPI document, and every socket, called for real as everybody there is."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from starlette.websockets import WebSocketDisconnect

from service.access.login.cookies import CookieScope, screen_cookie_name
from service.access.request.identity import Identity
from service.access.request.rules import BEFORE_THE_PASSWORD_IS_CHANGED, PEOPLE_ONLY, RULES, SOCKET, Open, RuleTable
from service.core.permissions import KEY_PERMISSIONS, ROLE_PERMISSIONS, Permission, Role
from service.core.settings.settings import Settings
from service.web.app import create_app
from tests.support.contract.document import contract_app
from tests.support.documents import access_matrix
from tests.support.generated_sections import are_as_made
from tests.support.service.accounts import PeopleClient, headers_of, open_login
from tests.support.service.fake_engine import FakeEngine

pytestmark = pytest.mark.slow

APP = contract_app()
DOCUMENT = APP.openapi()
CALLS = sorted(
    [(method.upper(), path) for path, item in DOCUMENT["paths"].items() for method in item]
    + [rule for rule in RULES if rule[0] == SOCKET or rule[1].endswith("openapi.json")]
)
ROLES = {role.value: ROLE_PERMISSIONS[role] for role in Role}
KEYS = {f"key with {scope}": frozenset({scope}) for scope in sorted(KEY_PERMISSIONS)}
NOT_LOGGED_IN = ("nobody", "expired", "idle", "disabled", "revoked key", "expired key", "made-up key", "made-up login")
SCREEN = "paired screen"
EVERYBODY = (*NOT_LOGGED_IN, "must change", SCREEN, *ROLES, *KEYS)
WITHOUT_LOG_IN = {"/api/v1/login", "/api/v1/login/oidc", "/api/v1/login/oidc/return", "/api/v1/coach/pair"}
ENDLESS = {"/api/v1/live/events": "?form=none"}
"""Answers without an end, and what is asked so that they are refused behind the guard instead."""
PRESENCE = ("POST", "/api/v1/sessions/{session_id}/presence")
FILL = {"login_id": "0" * 32, "key_id": "0" * 12, "name": "nobody"}


def url(path):
    for part in Path(path).parts:
        if part.startswith("{"):
            path = path.replace(part, FILL.get(part[1:-1], "0" * 32))
    return path


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    settings = Settings(data_dir=tmp_path_factory.mktemp("matrix"), allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings, lambda _settings: FakeEngine())) as client:
        client.speaks_as = None
        yield client


@pytest.fixture(scope="module")
def credentials(client):
    """What each of them sends."""
    store, keys = client.desk.store, client.desk.keys
    soon = datetime.now(UTC) + timedelta(days=1)
    made = {who: headers_of(open_login(store, who, [Role(who)])) for who in ROLES}
    for who, scopes in KEYS.items():
        made[who] = bearer(keys.create(who.replace(".", " "), scopes, soon, by="test").secret)
    for who in ("expired", "idle", "disabled", "must change"):
        made[who] = headers_of(open_login(store, who, Role))
    change(store, "expired", expires_at=datetime.now(UTC) - timedelta(seconds=1))
    change(store, "idle", seen_at=datetime.now(UTC) - timedelta(hours=1))
    spoil(store.users, "disabled", is_disabled=True)
    spoil(store.users, "must change", must_change_password=True)
    for who, taken in (("revoked key", "revoked_at"), ("expired key", "expires_at")):
        key = keys.create(who, KEY_PERMISSIONS, soon, by="test")
        spoil(store.keys, key.key.id, **{taken: datetime.now(UTC) - timedelta(seconds=1)})
        made[who] = bearer(key.secret)
    made["made-up key"] = bearer(f"{key.secret[:-4]}AAAA")
    made["made-up login"] = {"Cookie": f"tidegate_login={'A' * 43}", "Origin": "http://testserver"}
    made["nobody"] = {}
    screens = client.desk.screens
    token = screens.pair(screens.open_code(by="test").code, "127.0.0.1").token
    made[SCREEN] = {
        "Cookie": f"{screen_cookie_name(CookieScope(is_secure=False))}={token}",
        "Origin": "http://testserver",
    }
    return made


def bearer(secret):
    return {"Authorization": f"Bearer {secret}"}


def change(store, name, **changes):
    login = next(login for login in store.logins.values() if login.user_key == name)
    spoil(store.logins, login.key, **changes)


def spoil(shelf, key, **changes):
    from dataclasses import replace

    shelf[key] = replace(shelf[key], **changes)


def due(who, method, path):
    """Whether the table lets this one call this."""
    needs = RULES[method, path]
    if needs is Open.PUBLIC:
        return True
    if who in NOT_LOGGED_IN:
        return False
    if who == SCREEN:
        return needs is Permission.COACH_WATCH
    if who == "must change":
        return (method, path) in BEFORE_THE_PASSWORD_IS_CHANGED
    if who in KEYS and (method, path) in PEOPLE_ONLY:
        return False
    return needs is Open.ANYONE_LOGGED_IN or needs in (ROLES | KEYS)[who]


def is_let_in(client, method, path, headers):
    if method == SOCKET:
        return opens_a_stream(client, url(path), headers)
    answer = client.request(method, url(path) + ENDLESS.get(path, ""), headers=headers, follow_redirects=False)
    if path in WITHOUT_LOG_IN:
        return answer.status_code != 404  # it may answer 401 or 403 to whom it does not know: it was asked
    if answer.status_code in {401, 403}:
        assert answer.headers["content-type"] == "application/problem+json", answer.text
        assert (answer.status_code == 401) == ("www-authenticate" in answer.headers)
        return False
    return True


def opens_a_stream(client, path, headers):
    try:
        with client.websocket_connect(path, headers=dict(headers)) as socket:
            return socket.receive_json()["type"] == "hello"
    except WebSocketDisconnect as refused:
        return refused.code != 1008


@pytest.mark.parametrize("call", CALLS, ids=" ".join)
def test_a_call_is_open_only_to_the_roles_in_the_table(client, credentials, call):
    # A log-out ends the log-in, so each call gets its own.
    headers = {who: dict(credentials[who]) for who in EVERYBODY}
    if call[1].endswith(("/logout", "/me/password")):
        for who in ROLES:
            headers[who] = headers_of(open_login(client.desk.store, who))
    found = {who for who in EVERYBODY if is_let_in(client, *call, headers[who])}
    if call[1].endswith("/logout"):
        for who in ("must change",):
            credentials[who] = headers_of(open_login(client.desk.store, who))
    assert found == {who for who in EVERYBODY if due(who, *call)}


def test_every_route_and_socket_of_the_application_has_a_rule_and_every_rule_a_route():
    assert set(CALLS) == set(RULES)


def test_no_two_rules_fit_one_path():
    table = RuleTable()
    for method, template in RULES:
        fitting = [other for other in table.templates(url(template)) if (method, other) in RULES]
        assert fitting == [template]


def test_a_route_without_a_rule_is_refused_to_everybody(tmp_path):
    app = create_app(Settings(data_dir=tmp_path, allowed_hosts=("testserver",)), lambda _settings: FakeEngine())

    @app.get("/api/v1/forgotten")
    def forgotten():
        return "secret"

    app.router.routes.insert(0, app.router.routes.pop())
    with PeopleClient(app) as client:
        answer = client.get("/api/v1/forgotten")
        assert (answer.status_code, "secret" in answer.text) == (404, False)
        client.speaks_as = None
        assert client.get("/api/v1/forgotten").status_code == 401


def test_what_is_taken_from_a_machine_is_never_let_in_by_a_key_that_has_it_all_the_same():
    identity = Identity(kind="key", name="key:x", permissions=KEY_PERMISSIONS)
    assert not identity.permissions & {Permission.GATE_ACKNOWLEDGE, Permission.QA_RUN, Permission.USERS_MANAGE}


def test_a_paired_screen_watches_the_coaching_stream_and_nothing_else_of_all_routes():
    open_to_it = {call for call in RULES if due(SCREEN, *call) and RULES[call] is not Open.PUBLIC}
    assert open_to_it == {("GET", "/api/v1/coach/me"), (SOCKET, "/api/v1/coach/live")}


def test_a_screen_s_credential_is_refused_as_a_log_in_and_as_a_key(client, credentials):
    token = credentials[SCREEN]["Cookie"].partition("=")[2]
    for headers in ({"Cookie": f"tidegate_login={token}"}, bearer(token), bearer(f"tg_{'0' * 12}_{token}")):
        assert client.get("/api/v1/me", headers=headers).status_code == 401
    assert client.get("/api/v1/coach/me", headers=bearer(token)).status_code == 401


def test_only_physicists_start_qa_and_administrators_do_not():
    assert {role for role in Role if Permission.QA_RUN in ROLE_PERMISSIONS[role]} == {Role.PHYSICIST}


def test_a_key_that_may_arm_is_not_somebody_who_is_present(client, credentials):
    assert PRESENCE in PEOPLE_ONLY
    answer = client.post(url(PRESENCE[1]), json={"operator": "A. Therapist"}, headers=credentials["key with gate.arm"])
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["bound"]) == (403, "person_required", "a person's log-in")
    assert (problem["field"], problem["value"]) == ("caller", "'key'")
    answer = client.post(url(PRESENCE[1]), json={}, headers=credentials["therapist"])
    assert (answer.status_code, answer.json()["code"]) == (404, "not_found")


def test_only_roles_that_treat_can_arm_and_administrators_cannot():
    may_arm = {role for role in Role if Permission.GATE_ARM in ROLE_PERMISSIONS[role]}
    assert may_arm == {Role.THERAPIST, Role.PHYSICIST}
    may_take_away = {role for role in Role if Permission.GATE_HOLD in ROLE_PERMISSIONS[role]}
    assert may_take_away == {Role.THERAPIST, Role.PHYSICIST, Role.ADMIN}


def test_the_page_of_the_handbook_has_the_table():
    assert are_as_made(access_matrix.DOCUMENT, access_matrix.MADE), (
        "run `python -m tests.support.documents.access_matrix --write`"
    )
