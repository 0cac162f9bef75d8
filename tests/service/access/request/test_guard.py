"""The guard over HTTP: cookies, origins, paths that try to get round it, log-ins as a browser does them."""

import json
import re

import pytest
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from service.core.permissions import Role
from service.core.settings.settings import Settings
from service.web.app import create_app
from service.web.middleware import guard
from tests.support.service.accounts import PASSWORD, PeopleClient, QuickHashing, headers_of, open_login
from tests.support.service.api_calls import audit_rows
from tests.support.service.fake_engine import FakeEngine
from tests.support.waiting import eventually

OURS = {"Origin": "http://testserver"}
JSON = {"Content-Type": "application/json"}


@pytest.fixture
def quick(anonymous):
    """A service whose passwords cost nothing, with one person in it."""
    hashing = QuickHashing()
    desk = anonymous.desk
    desk.logins._hashing = hashing
    desk.passwords._pause_s = 0.0
    desk.accounts._hash = hashing.hash
    desk.accounts.add("root", [Role.ADMIN], by="test", password=PASSWORD)
    desk.accounts.add("B. Physicist", [Role.PHYSICIST], by="test", password=PASSWORD)
    return anonymous


@pytest.fixture(scope="module")
def one_door(tmp_path_factory):
    """A service that many tests share: none of them leaves anything behind."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("door"), allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings, lambda _settings: FakeEngine())) as client:
        client.speaks_as = None
        yield client


@pytest.fixture
def door(one_door):
    one_door.cookies.clear()
    one_door.speaks_as = None
    return one_door


def log_in(client, name="B. Physicist", password=PASSWORD, **headers):
    return client.post("/api/v1/login", json={"name": name, "password": password}, headers={**OURS, **headers})


def test_a_browser_logs_in_asks_and_logs_out(quick):
    answer = log_in(quick)
    assert answer.status_code == 200
    assert answer.json()["name"] == "B. Physicist"
    assert answer.json()["roles"] == ["physicist"]
    assert "gate.arm" in answer.json()["permissions"]
    assert quick.get("/api/v1/me").json()["name"] == "B. Physicist"
    assert quick.post("/api/v1/logout", headers=OURS).status_code == 415
    assert quick.post("/api/v1/logout", headers={**OURS, **JSON}).status_code == 204
    assert quick.get("/api/v1/me").status_code == 401


def test_the_cookie_is_out_of_reach_and_stands_in_no_address_and_no_body(quick):
    answer = log_in(quick)
    cookie = answer.headers["set-cookie"]
    token = re.match(r"tidegate_login=([\w-]{43});", cookie)[1]
    assert {part.strip().lower() for part in cookie.split(";")[1:]} == {"httponly", "path=/", "samesite=strict"}
    assert token not in answer.text
    assert token not in json.dumps(dict(quick.get("/api/v1/me").headers))
    quick.cookies.clear()
    assert quick.get(f"/api/v1/me?tidegate_login={token}&token={token}").status_code == 401


@pytest.mark.parametrize("secure", [{"behind_proxy": True}], ids=str)
def test_behind_a_proxy_the_cookie_travels_by_tls_alone_and_only_for_this_host(site, secure):
    settings = site.model_copy(update=secure)
    with PeopleClient(create_app(settings, lambda _settings: FakeEngine()), base_url="https://testserver") as client:
        client.speaks_as = None
        client.desk.logins._hashing = QuickHashing()
        client.desk.accounts._hash = QuickHashing().hash
        client.desk.accounts.add("root", [Role.ADMIN], by="test", password=PASSWORD)
        cookie = log_in(client, "root", Origin="https://testserver").headers["set-cookie"]
        assert cookie.startswith("__Host-tidegate_login=")
        assert {"secure", "httponly", "samesite=strict", "path=/"} <= {
            part.strip().lower() for part in cookie.split(";")[1:]
        }
        assert client.get("/api/v1/me").status_code == 200
        assert log_in(client, "root", Origin="http://testserver").status_code == 403


def test_a_failed_log_in_does_not_reveal_the_reason(quick):
    answers = [log_in(quick, password="wrong password"), log_in(quick, name="nobody at all")]
    assert [answer.status_code for answer in answers] == [401, 401]
    assert answers[0].json() == answers[1].json()
    assert "set-cookie" not in answers[0].headers
    assert answers[0].headers["www-authenticate"] == answers[1].headers["www-authenticate"]


def test_too_many_failures_say_when_to_come_again_and_leave_who_is_in_alone(quick):
    assert log_in(quick).status_code == 200
    for _ in range(5):
        assert log_in(quick, password="wrong password").status_code == 401
    locked = log_in(quick)
    assert (locked.status_code, locked.json()["code"]) == (429, "locked_out")
    assert 1 <= int(locked.headers["retry-after"]) <= 2
    assert quick.get("/api/v1/sessions").status_code == 200


def test_a_full_password_desk_states_it_at_once(quick):
    desk = quick.desk.passwords
    for _ in range(8):
        desk._slots.acquire()
    answer = log_in(quick)
    assert (answer.status_code, answer.json()["code"], answer.headers["retry-after"]) == (503, "login_busy", "1")


@pytest.mark.parametrize("body", [{"name": "root", "password": 5}, {"name": "root", "password": ["hunter2hunter2"]}])
def test_what_was_sent_as_a_password_is_never_shown_again(quick, body):
    answer = quick.post("/api/v1/login", json={**body, "hunter2hunter2": 1}, headers=OURS)
    assert answer.status_code == 422
    assert "hunter2hunter2" not in answer.json().get("value", "")
    quick.speaks_as = "A. Therapist"
    answer = quick.post("/api/v1/me/password", json={"old_password": "hunter2hunter2", "new_password": "hunter"})
    assert answer.status_code == 422
    assert "hunter" not in answer.text
    assert "hunter" not in json.dumps(audit_rows(quick))


def test_with_a_generated_password_only_changing_it_is_allowed(quick):
    one_time = quick.post(
        "/api/v1/users",
        json={"name": "C. Nurse", "roles": ["therapist"]},
        headers=headers_of(open_login(quick.desk.store, "root", [Role.ADMIN])),
    ).json()["one_time_password"]
    me = log_in(quick, "C. Nurse", one_time).json()
    assert me["must_change_password"] is True
    refused = quick.get("/api/v1/sessions")
    assert (refused.status_code, refused.json()["code"]) == (403, "password_change_due")
    with pytest.raises(WebSocketDisconnect), quick.websocket_connect("/api/v1/live"):
        pass
    change = {"old_password": one_time, "new_password": "one that I chose myself"}
    assert quick.post("/api/v1/me/password", json=change, headers=OURS).status_code == 204
    assert quick.get("/api/v1/sessions").status_code == 200
    assert quick.get("/api/v1/me").json()["must_change_password"] is False


def test_a_wrong_old_password_is_no_end_of_the_log_in(quick):
    log_in(quick)
    change = {"old_password": "not that", "new_password": "one that I chose myself"}
    answer = quick.post("/api/v1/me/password", json=change, headers=OURS)
    assert (answer.status_code, answer.json()["code"]) == (422, "wrong_password")
    assert quick.get("/api/v1/me").status_code == 200


def test_a_person_ends_their_other_log_ins_and_an_administrator_any_person_s(quick):
    log_in(quick)
    there = headers_of(open_login(quick.desk.store, "B. Physicist"))
    listed = quick.get("/api/v1/me/logins").json()["items"]
    assert [login["is_this"] for login in listed] == [True, False]
    other = next(login["id"] for login in listed if not login["is_this"])
    assert quick.post(f"/api/v1/me/logins/{other}/end", json={}, headers=OURS).status_code == 204
    quick.cookies.clear()
    assert quick.get("/api/v1/me", headers=there).status_code == 401
    admin = headers_of(open_login(quick.desk.store, "root"))
    left = quick.get("/api/v1/users/B.%20Physicist/logins", headers=admin).json()["items"]
    url = f"/api/v1/users/B.%20Physicist/logins/{left[0]['id']}/end"
    assert quick.post(url, json={}, headers=admin).status_code == 204
    assert quick.get("/api/v1/users/B.%20Physicist/logins", headers=admin).json()["items"] == []


@pytest.mark.parametrize(
    "origin",
    [
        None,
        "null",
        "",
        "http://evil.example",
        "http://testserver.evil.example",
        "http://testserver:81",
        "http://testserver@evil.example",
        "file://testserver",
        "http://[",
        "http://evil.example/http://testserver",
    ],
)
def test_a_call_with_a_cookie_that_does_not_come_from_our_page_changes_nothing(door, origin):
    mine = headers_of(open_login(door.desk.store, "B. Physicist"))
    headers = {**JSON, "Cookie": mine["Cookie"]} | ({} if origin is None else {"Origin": origin})
    answer = door.post("/api/v1/logout", content=b"{}", headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (403, "origin_refused")
    assert door.get("/api/v1/me", headers=mine).status_code == 200


def test_a_foreign_page_cannot_log_a_browser_in_as_somebody(quick):
    assert log_in(quick, Origin="http://evil.example").status_code == 403


def test_a_page_that_the_site_lets_in_may_call(site):
    settings = site.model_copy(update={"allowed_origins": ("https://wall.example",)})
    with PeopleClient(create_app(settings, lambda _settings: FakeEngine())) as client:
        headers = {"Origin": "https://wall.example"}
        assert client.post("/api/v1/logout", json={}, headers=headers).status_code == 204


def test_a_key_needs_no_origin_and_a_foreign_page_cannot_send_one(quick):
    from datetime import timedelta

    desk = quick.desk
    made = desk.keys.create("planning", ["sessions.run"], desk.store.now() + timedelta(days=1), by="test")
    bearer = {"Authorization": f"Bearer {made.secret}", **JSON}
    assert quick.post("/api/v1/sessions", content=b"{}", headers=bearer).status_code == 422
    foreign = {**bearer, "Origin": "http://evil.example"}
    assert quick.post("/api/v1/sessions", content=b"{}", headers=foreign).status_code == 403


@pytest.mark.parametrize(
    "path",
    [
        "//api/v1/sessions",
        "/api/v1/sessions/",
        "/api//v1/sessions",
        "/API/v1/sessions",
        "/api/v1/./sessions",
        "/index.html/../api/v1/sessions",
        "/%61pi/v1/sessions",
        "/api%2fv1/sessions",
        "/api/v1/sessions%0a",
        "/api/v1/sessions;x=1",
        "/api/v1/sessions%00",
        "/metrics/",
        "/css/../metrics",
        "/./metrics",
    ],
)
def test_no_way_of_writing_a_path_gets_round_the_guard(door, path):
    answer = door.get(path)
    assert answer.status_code == 401
    assert "items" not in answer.text


@pytest.mark.parametrize("method", ["HEAD", "OPTIONS", "TRACE", "DELETE", "PATCH", "PROPFIND", "get", "WEBSOCKET"])
@pytest.mark.parametrize("path", ["/api/v1/sessions", "/metrics", "/api/v1/live", "/api/v1/users"])
def test_no_method_gets_round_the_guard(door, method, path):
    answer = door.request(method, path, headers={"X-HTTP-Method-Override": "GET"})
    assert answer.status_code in {401, 403}


def test_a_socket_is_no_way_to_a_call_and_a_call_none_to_a_socket(door):
    with pytest.raises(WebSocketDisconnect) as refused, door.websocket_connect("/api/v1/sessions"):
        pass
    assert refused.value.code == 1008
    door.speaks_as = "A. Therapist"
    with pytest.raises(WebSocketDisconnect), door.websocket_connect("/api/v1/sessions"):
        pass
    assert door.get("/api/v1/live").status_code == 404


def test_the_body_of_an_unknown_caller_is_not_read(anonymous, monkeypatch):
    read = []

    async def inner(_scope, receive, _send):
        read.append(await receive())

    checked = guard.Guard(
        inner,
        callers=guard.ClientAddresses(behind_proxy=False, trusted_proxies=()),
        allowed_origins=(),
        is_secure=False,
        page_files=frozenset(),
    )
    app = anonymous.app

    async def asked(scope, receive, send):
        if scope["type"] == "http":
            scope["app"] = app
        await checked(scope, receive, send)

    outside = TestClient(asked)
    assert outside.post("/api/v1/sessions", content=b"x" * 10_000).status_code == 401
    assert read == []


def test_page_liveness_and_contract_are_public_and_nothing_else_beside_them(door):
    assert door.get("/").status_code == 200
    assert door.get("/index.html").status_code == 200
    assert door.get("/none.html").status_code == 401
    assert door.get("/healthz").json() == {"status": "ok"}
    assert door.get("/readyz").status_code == 401
    assert door.get("/api/v1/openapi.json").json()["openapi"].startswith("3.1")
    assert door.get("/api/v1/machine").status_code == 401


def test_a_refusal_names_what_is_missing_and_is_audited_with_who_and_what(anonymous):
    headers = headers_of(open_login(anonymous.desk.store, "Viewer", [Role.VIEWER]))
    answer = anonymous.post(f"/api/v1/sessions/{'0' * 32}/arm", json={}, headers=headers)
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["bound"]) == (403, "permission_missing", "gate.arm")
    assert "Viewer does not have the permission gate.arm" in problem["detail"]
    anonymous.desk.cleanup_worker.write_refusals()
    anonymous.speaks_as = "A. Therapist"
    (row,) = [row for row in audit_rows(anonymous, "access.refused") if row["actor"] == "Viewer"]
    assert (row["outcome"], row["detail"]["needs"], row["detail"]["method"]) == ("refused", "gate.arm", "POST")
    assert row["detail"]["path"] == "/api/v1/sessions/{session_id}/arm"


def test_a_flood_of_unknown_callers_costs_one_row_that_counts_them(quick):
    for _ in range(30):
        assert quick.get("/api/v1/sessions").status_code == 401
    log_in(quick, "nobody at all", "wrong password")
    quick.desk.cleanup_worker.write_refusals()
    quick.desk.cleanup_worker.write_summary()
    quick.desk.cleanup_worker.write_summary()
    quick.speaks_as = "A. Therapist"
    (row,) = audit_rows(quick, "access.refused")
    assert row["detail"]["counts"] == {"not logged in": 30, "failed log-ins of unknown names": 1}
    assert row["detail"]["addresses"] == {"unknown": 31}
    assert "nobody at all" not in json.dumps(audit_rows(quick))


def test_a_flood_of_refusals_of_somebody_known_is_bounded(anonymous):
    headers = headers_of(open_login(anonymous.desk.store, "Viewer", [Role.VIEWER]))
    anonymous.desk.cleanup_worker._worker.stop(30.0)
    for _ in range(300):
        assert anonymous.get("/api/v1/users", headers=headers).status_code == 403
    assert len(anonymous.desk.refused_logins.take_events()) == 10
    assert anonymous.desk.refused_logins.take_summary().detail["counts"] == {"access.refused of Viewer": 290}
    assert anonymous.get("/api/v1/users", headers=headers).status_code == 403
    assert len(anonymous.desk.refused_logins.take_events()) == 1  # another minute


def test_failures_of_a_known_name_are_audited_by_it(quick):
    log_in(quick, password="wrong password")
    quick.desk.cleanup_worker.write_refusals()
    quick.speaks_as = "A. Therapist"
    row = [row for row in audit_rows(quick, "user.login") if row["outcome"] == "refused"][-1]
    assert (row["actor"], row["detail"]["failures"]) == ("B. Physicist", 1)


def read_to_the_end(socket):
    for _ in range(10):
        socket.receive_json()


@pytest.mark.parametrize("ends", ["log-out", "disabled", "revoked"])
def test_a_stream_closes_within_seconds_when_what_opened_it_is_over(quick, ends):
    from datetime import timedelta

    desk = quick.desk
    opened = open_login(desk.store, "B. Physicist")
    key = desk.keys.create("wall", ["sessions.read"], desk.store.now() + timedelta(days=1), by="test")
    headers = {"Authorization": f"Bearer {key.secret}"} if ends == "revoked" else headers_of(opened)
    with quick.websocket_connect("/api/v1/live", headers=headers) as socket:
        assert socket.receive_json()["type"] == "hello"
        if ends == "revoked":
            desk.keys.revoke(key.key.id, by="test")
        elif ends == "disabled":
            from service.access.accounts.people import Change

            desk.accounts.change("B. Physicist", Change(is_disabled=True), by="test")
        else:
            desk.logins.log_out(opened.login)
        with pytest.raises(WebSocketDisconnect) as closed:
            read_to_the_end(socket)
        assert (closed.value.code, closed.value.reason) == (1008, "not_logged_in")


def test_who_is_in_stays_in_and_holds_while_the_database_does_not_answer(quick, monkeypatch):
    from sqlalchemy.exc import OperationalError

    log_in(quick)

    def broken():
        raise OperationalError("down", None, Exception())

    monkeypatch.setattr(quick.desk.store._database, "write", broken)
    monkeypatch.setattr(quick.desk.store._database, "read", broken)
    assert quick.get("/api/v1/me").status_code == 200
    assert log_in(quick, name="root").status_code == 503


def test_refusals_are_written_by_the_keeper_itself(anonymous):
    headers = headers_of(open_login(anonymous.desk.store, "Viewer", [Role.VIEWER]))
    anonymous.get("/api/v1/users", headers=headers)
    anonymous.speaks_as = "A. Therapist"
    eventually(lambda: len(audit_rows(anonymous, "access.refused")) == 1)


def test_two_origins_are_none_of_ours(door):
    mine = headers_of(open_login(door.desk.store, "B. Physicist"))
    headers = [("Cookie", mine["Cookie"]), *JSON.items(), *OURS.items(), ("Origin", "http://evil.example")]
    request = door.build_request("POST", "/api/v1/logout", content=b"{}", headers=headers)
    assert door.send(request).status_code == 403
