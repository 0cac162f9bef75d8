"""Every error is a problem with a stable code; the table knows every error there is."""

import inspect

import pytest

import engine.core.errors
import service.core.errors
from engine.core.errors import TidegateError
from service.web.app import create_app
from service.web.middleware.requests import MAX_BODY_BYTES
from service.web.problems.table import STATUS_OF, problem_of
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import audit_rows, make_calibration, upload

pytestmark = pytest.mark.slow

KINDS = {
    kind
    for module in (engine.core.errors, service.core.errors)
    for _, kind in inspect.getmembers(module, inspect.isclass)
    if issubclass(kind, TidegateError)
}
NEVER_IN_AN_ANSWER = {"TidegateError", "ServiceError", "SourceEndedError", "FrameTimeoutError", "SourceAwayError"}


@pytest.mark.parametrize("kind", sorted(KINDS, key=lambda kind: kind.__name__), ids=lambda kind: kind.__name__)
def test_every_error_has_its_place_in_the_table(kind):
    if kind.__name__ in NEVER_IN_AN_ANSWER:
        return
    assert any(base in STATUS_OF for base in kind.__mro__)


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/api/v1/nothing", 404, "not_found"),
        ("GET", "/none.html", 404, "not_found"),
        ("GET", "/../../etc/passwd", 404, "not_found"),
        ("GET", "/%2e%2e/%2e%2e/etc/passwd", 404, "not_found"),
        ("DELETE", "/api/v1/sessions", 405, "method_not_allowed"),
        ("PUT", "/api/v1/audit", 405, "method_not_allowed"),
        ("DELETE", "/api/v1/audit", 405, "method_not_allowed"),
        ("GET", "/api/v1/sessions/xyz", 422, "invalid_value"),
    ],
)
def test_what_is_not_there_is_a_problem_too(client, method, path, status, code):
    answer = client.request(method, path)
    assert (answer.status_code, answer.json()["code"]) == (status, code)
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["type"] == f"urn:tidegate:problem:{code}"
    assert answer.json()["status"] == status


@pytest.mark.parametrize("media_type", ["text/plain", "application/x-www-form-urlencoded", "", "multipart/form-data"])
def test_a_body_that_is_not_json_by_its_type_is_refused(client, session_id, media_type):
    for path in ("/api/v1/sessions", f"/api/v1/sessions/{session_id}/arm", "/api/v1/calibrations?operator=me"):
        answer = client.post(path, content=b'{"operator": "me"}', headers={"Content-Type": media_type})
        assert (answer.status_code, answer.json()["code"]) == (415, "media_type")
    assert audit_rows(client, "session.arm")[-1]["outcome"] == "refused"


@pytest.mark.parametrize("body", [b"", b"{", b"{'operator': 1}", b"\xff", b'{"operator": "\\ud800"}', b"[" * 30_000])
def test_a_body_that_is_no_json_is_refused(client, session_id, body):
    answer = client.post(
        f"/api/v1/sessions/{session_id}/arm", content=body, headers={"Content-Type": "application/json"}
    )
    assert answer.status_code in {400, 422}
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_body_of_any_call_is_bounded(client, session_body):
    session_body["plan_id"] = "x" * MAX_BODY_BYTES
    answer = client.post("/api/v1/sessions", json=session_body)
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["field"]) == (413, "body_too_large", "body")
    assert str(MAX_BODY_BYTES) in problem["bound"]


@pytest.mark.parametrize("length", ["-1", "1e9", "abc", "9" * 30])
def test_a_nonsense_length_is_refused(client, length):
    answer = upload(client, b"{}", **{"Content-Length": length})
    assert answer.status_code in {400, 413}


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8000", "", "testserver.evil.example"])
def test_a_name_that_is_not_ours_is_refused(client, host):
    answer = client.get("/healthz", headers={"Host": host})
    assert (answer.status_code, answer.json()["code"]) == (421, "host_refused")


def test_every_answer_carries_the_security_headers(client):
    for path in ("/healthz", "/", "/api/v1/nothing", "/api/v1/sessions"):
        headers = client.get(path).headers
        assert headers["Content-Security-Policy"].startswith("default-src 'self';")
        assert "unsafe" not in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"


def test_an_unexpected_error_reports_nothing_of_the_inside(settings, engine):
    def broken():
        msg = "secret inside"
        raise RuntimeError(msg)

    engine.devices = broken
    app = create_app(settings, lambda _settings: engine)
    with PeopleClient(app, raise_server_exceptions=False) as client:
        answer = client.get("/api/v1/devices")
    assert (answer.status_code, answer.json()["code"]) == (500, "internal_error")
    assert "secret" not in answer.text


def test_an_error_that_is_not_in_the_table_is_an_internal_one():
    assert problem_of(ZeroDivisionError("x")).status == 500


def test_the_page_is_served_from_here(client):
    answer = client.get("/")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/html")


def test_the_page_makes_no_request_to_other_hosts(client):
    text = client.get("/").text
    assert "https://" not in text
    assert "http://" not in text


def test_health_readiness_and_devices_answer(client):
    assert client.get("/healthz").json() == {"status": "ok"}
    ready = client.get("/readyz").json()
    assert (ready["is_ready"], ready["not_ready"], ready["reasons"]) == (True, [], [])
    assert client.get("/api/v1/devices").json()["items"][0]["name"] == "Fake Xtion"


def test_a_missing_recordings_folder_is_not_ready(client, settings):
    for file in settings.recordings_dirs[0].iterdir():
        file.unlink()
    settings.recordings_dirs[0].rmdir()
    answer = client.get("/readyz")
    assert answer.status_code == 503
    assert "recordings" in answer.json()["not_ready"][0]


def test_who_is_logged_in_is_named_in_the_audit_of_a_refused_body_whatever_it_states(client, session_body):
    client.post("/api/v1/sessions", json=session_body | {"fraction_number": 0})
    assert audit_rows(client, "session.create")[-1]["actor"] == "A. Therapist"
    client.speaks_as = "B. Physicist"
    client.post("/api/v1/sessions", json=session_body | {"operator": "a\nb"})
    assert audit_rows(client, "session.create")[-1]["actor"] == "B. Physicist"


def test_names_outside_of_ascii_are_kept(client):
    answer = client.post(
        "/api/v1/calibrations",
        params={"operator": "Zoë Žižka"},
        content=make_calibration().to_json(),
        headers={"Content-Type": "application/json; charset=utf-8"},
    )
    assert answer.json()["uploaded_by"] == "Zoë Žižka"
