"""Every answer says which request it belongs to; what a caller calls it is kept where it can do no harm."""

import logging
import re
from contextvars import copy_context

import pytest
from starlette.testclient import WebSocketDenialResponse

from service.core.current_request import begin_request, current_request_id, current_session_id, request_id_of

MADE = re.compile(r"[0-9a-f]{32}")
SESSION = "0123456789abcdef" * 2


@pytest.mark.parametrize("given", ["a", "Scan-1.2_3", "x" * 64])
def test_a_valid_id_is_kept(client, given):
    assert client.get("/healthz", headers={"X-Request-ID": given}).headers["X-Request-ID"] == given


@pytest.mark.parametrize(
    "given", [b"", b"x" * 65, b"two words", b"line\nbreak", b"\x1b[31mred", b"../..", "ä".encode(), b'"']
)
def test_an_id_that_could_forge_a_log_line_is_replaced(given):
    assert MADE.fullmatch(request_id_of([given]))


def test_two_ids_are_none():
    assert MADE.fullmatch(request_id_of([b"one", b"two"]))


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/healthz", 200),
        ("GET", "/", 200),
        ("GET", "/nothing/here", 404),
        ("PUT", "/api/v1/sessions", 405),
        ("POST", "/api/v1/sessions", 415),
        ("GET", f"/api/v1/sessions/{SESSION}", 404),
    ],
)
def test_every_answer_has_one(client, method, path, status):
    answer = client.request(method, path)
    assert answer.status_code == status
    assert MADE.fullmatch(answer.headers["X-Request-ID"])


def test_so_has_one_that_was_refused_at_the_door(client):
    assert client.get("/healthz", headers={"Host": "elsewhere"}).status_code == 421
    assert MADE.fullmatch(client.get("/healthz", headers={"Host": "elsewhere"}).headers["X-Request-ID"])


def test_an_unexpected_failure_has_one_too_and_the_same_headers(client, monkeypatch):
    def broken():
        raise ZeroDivisionError

    monkeypatch.setattr(client.app.state.services.health, "readiness", broken)
    answer = client.get("/readyz", headers={"X-Request-ID": "mine"})
    assert (answer.status_code, answer.json()["code"]) == (500, "internal_error")
    assert answer.headers["X-Request-ID"] == "mine"
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_a_socket_has_one_as_well(client):
    with client.websocket_connect("/api/v1/live", headers={"X-Request-ID": "mine"}) as socket:
        assert (b"x-request-id", b"mine") in socket.extra_headers


def test_what_a_worker_thread_logs_belongs_to_the_request(client, monkeypatch):
    seen = []
    readiness = client.app.state.services.health.readiness

    def reported():
        seen.append((current_request_id(), current_session_id()))
        return readiness()

    monkeypatch.setattr(client.app.state.services.health, "readiness", reported)
    client.get("/readyz", headers={"X-Request-ID": "mine"})
    client.get("/readyz", headers={"X-Request-ID": "yours"})
    assert seen == [("mine", None), ("yours", None)]


def test_the_session_is_the_one_of_the_path():
    def session_of(path):
        begin_request("mine", path)
        return current_session_id()

    assert copy_context().run(session_of, f"/api/v1/sessions/{SESSION}/arm") == SESSION
    assert copy_context().run(session_of, "/api/v1/sessions/../../etc/passwd") is None


def access_lines(caplog):
    return [record.fields for record in caplog.records if record.name == "service.web.middleware.request_log"]


def test_a_request_leaves_one_line_with_its_route_and_not_its_path(client, caplog):
    with caplog.at_level(logging.INFO, "service.web.middleware.request_log"):
        client.get(f"/api/v1/sessions/{SESSION}", params={"patient": "P-0001"})  # which it does not take
        client.get("/api/v1/P-0001")
    first, second = access_lines(caplog)
    assert (first["method"], first["route"], first["status"]) == ("GET", "/api/v1/sessions/{session_id}", 422)
    assert (first["caller"], first["duration_ms"] >= 0.0, first["bytes"] > 0) == ("person", True, True)
    assert second["route"] == "unknown"
    assert "P-0001" not in caplog.text


def test_what_machines_ask_all_the_time_leaves_none_unless_it_fails(client, caplog, monkeypatch):
    with caplog.at_level(logging.INFO, "service.web.middleware.request_log"):
        for path in ("/healthz", "/readyz", "/metrics"):
            client.get(path)
        assert access_lines(caplog) == []
        monkeypatch.setattr(client.app.state.services.health, "readiness", lambda: 1 / 0)
        client.get("/readyz")
    assert [line["status"] for line in access_lines(caplog)] == [500]


def test_no_person_is_named(client, caplog):
    with caplog.at_level(logging.INFO, "service.web.middleware.request_log"):
        client.get("/api/v1/me")
        client.speaks_as = None
        try:
            client.get("/api/v1/me")
        finally:
            client.speaks_as = "A. Therapist"
    assert [line["caller"] for line in access_lines(caplog)] == ["person", "nobody"]
    assert "Therapist" not in caplog.text


def test_a_socket_that_is_refused_with_a_problem_counts_with_its_status(client, caplog):
    with (
        caplog.at_level(logging.INFO, "service.web.middleware.request_log"),
        pytest.raises(WebSocketDenialResponse) as refused,
        client.websocket_connect("/api/v1/live?rate_hz=nonsense", headers={"X-Request-ID": "mine"}),
    ):
        pass
    assert (refused.value.status_code, refused.value.headers["X-Request-ID"]) == (422, "mine")
    (line,) = access_lines(caplog)
    assert (line["method"], line["status"], line["bytes"] > 0) == ("WEBSOCKET", 422, True)
