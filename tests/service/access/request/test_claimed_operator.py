"""Calls that take permission away are executed with any body for a permitted caller; an unread body is recorded."""

import json
from datetime import UTC, datetime, timedelta

import anyio
import pytest

from service.access.request.identity import ClaimedOperator, read_claim
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.fake_engine import FakeRunning

pytestmark = [pytest.mark.slow, pytest.mark.verification]

AWAY = ["hold", "disarm", "stop"]
JSON = "application/json"
UNREAD = {
    "no body": (b"", JSON, None),
    "nothing at all": (b"", None, None),
    "an empty object": (b"{}", JSON, None),
    "the type of a form": (b"{}", "application/x-www-form-urlencoded", None),
    "a form": (b"operator=me", "application/x-www-form-urlencoded", "it is no JSON"),
    "an unknown field": (b'{"operator": "A. Therapist", "force": true}', JSON, "it has other fields"),
    "an unknown field alone": (b'{"reason": "cough"}', JSON, "it has other fields"),
    "half of an object": (b'{"operator": ', JSON, "it is no JSON"),
    "no text": (b"\xff\xfe\xfd", JSON, "it is no JSON"),
    "without end": (b"[" * 30_000, JSON, "it is no JSON"),
    "a list": (b"[]", JSON, "it is no object"),
    "a number for a name": (b'{"operator": 3}', JSON, "its operator is no name"),
    "no name": (b'{"operator": ""}', JSON, "its operator is no name"),
    "a name without end": (json.dumps({"operator": "x" * 81}).encode(), JSON, "its operator is no name"),
    "half a character": (b'{"operator": "\\ud800"}', JSON, "its operator is no name"),
    "a field that is half a character": (b'{"\\ud800": 1}', JSON, "it has other fields"),
}
LENGTH, PACKED = "Content-Length", "Content-Encoding"
UNFINISHED = {
    "never comes": ({LENGTH: "10"}, []),
    "stops on its way": ({LENGTH: "10"}, [{"type": "http.request", "body": b"{", "more_body": True}]),
    "has lost its sender": ({LENGTH: "10"}, [{"type": "http.disconnect"}]),
    "says it is too large": ({LENGTH: "99999999"}, []),
    "is larger than it may be": ({}, [{"type": "http.request", "body": b" " * 99_999, "more_body": True}]),
    "is packed": ({LENGTH: "2", PACKED: "gzip"}, [{"type": "http.request", "body": b"{}", "more_body": False}]),
}
"""What a call says beforehand of its body, and what comes of it before nothing more does."""
LONGEST_S = 20.0
FOR_WHOM = {b"": None, b'{"operator": "C. Nurse", "force": 1}': "C. Nurse", b'{"operator": 3}': None}


def send(client, session_id, action, body, media_type, **headers):
    typed = {} if media_type is None else {"Content-Type": media_type}
    return client.post(f"/api/v1/sessions/{session_id}/{action}", content=body, headers={**typed, **headers})


def by_key(client) -> dict[str, str]:
    """Let calls be a machine's from here on."""
    key = client.desk.keys.create("tps", ["gate.hold"], datetime.now(UTC) + timedelta(days=1), by="test")
    client.speaks_as = None
    return {"Authorization": f"Bearer {key.secret}"}


def status_of(client, path: str, headers: dict[str, str], messages: list) -> int:
    """Call the application itself, with a body of which only so much comes; fails where nothing is answered."""
    coming, sent = iter(messages), []
    raw = [(name.lower().encode(), value.encode()) for name, value in {"Host": "testserver", **headers}.items()]
    said = {"method": "POST", "path": path, "raw_path": path.encode(), "headers": raw, "query_string": b""}
    scope = {"type": "http", "http_version": "1.1", "scheme": "http", "root_path": "", "client": ("127.0.0.1", 5)}

    async def receive():
        message = next(coming, None)
        return await anyio.sleep_forever() if message is None else message

    async def send(message):
        sent.append(message)

    async def call():
        with anyio.fail_after(LONGEST_S):
            await client.app({**scope, **said, "asgi": {"version": "3.0"}, "state": {}}, receive, send)

    client.portal.call(call)
    return sent[0]["status"]


def was_reported(running, action: str) -> bool:
    return running.status.is_over if action == "stop" else len(running.commands) == 1


@pytest.fixture
def begun(client, session_body, engine):
    """Begin a session and end the one before: a session that was stopped takes no second call."""
    kept = []

    def begin() -> tuple[str, FakeRunning]:
        if kept and not kept[-1][1].status.is_over:
            assert act(client, kept[-1][0], "stop").status_code == 200
        session_id = client.post("/api/v1/sessions", json=session_body).json()["id"]
        assert act(client, session_id, "start").status_code == 200
        kept.append((session_id, engine.running))
        return kept[-1]

    return begin


@pytest.mark.parametrize("action", AWAY)
def test_it_is_done_whatever_its_body_is_and_the_audit_states_what_was_not_read(client, begun, subtests, action):
    machine = by_key(client)
    for name in UNREAD if action == "hold" else ("no body", "half of an object", "a number for a name"):
        with subtests.test(name):
            body, media_type, unread = UNREAD[name]
            client.speaks_as = "A. Therapist"
            session_id, running = begun()
            client.speaks_as = None
            answer = send(client, session_id, action, body, media_type, **machine)
            assert answer.status_code == 200, answer.text
            assert was_reported(running, action)
            client.speaks_as = "A. Therapist"
            row = audit_rows(client, f"session.{action}")[-1]
            assert (row["actor"], row["outcome"], row["session_id"]) == ("key:tps", "done", session_id)
            assert row["detail"].get("body_not_read") == unread


@pytest.mark.parametrize("action", AWAY)
def test_it_is_done_though_its_body_does_not_come_whole(client, begun, subtests, action):
    machine = by_key(client)
    for name, (said, messages) in UNFINISHED.items():
        with subtests.test(name):
            client.speaks_as = "A. Therapist"
            session_id, running = begun()
            client.speaks_as = None
            assert status_of(client, f"/api/v1/sessions/{session_id}/{action}", machine | said, messages) == 200
            assert was_reported(running, action)
            client.speaks_as = "A. Therapist"
            row = audit_rows(client, f"session.{action}")[-1]
            found = (row["actor"], row["session_id"], row["detail"].get("body_not_read"))
            assert found == ("key:tps", session_id, "it did not come whole")


@pytest.mark.parametrize("action", AWAY)
def test_of_a_person_s_call_no_body_is_waited_for_nor_read(client, begun, subtests, monkeypatch, action):
    monkeypatch.setattr("service.web.dependencies.BODY_WAIT_S", 10 * LONGEST_S)
    person = client.headers_as("A. Therapist")
    for name in [*UNFINISHED, *(UNREAD if action == "hold" else ())]:
        with subtests.test(name):
            session_id, running = begun()
            body, media_type, _ = UNREAD.get(name, (b"", None, None))
            whole = {"type": "http.request", "body": body, "more_body": False}
            typed = {} if media_type is None else {"Content-Type": media_type}
            said, messages = UNFINISHED.get(name, (typed, [whole]))
            assert status_of(client, f"/api/v1/sessions/{session_id}/{action}", person | said, messages) == 200
            assert was_reported(running, action)
            row = audit_rows(client, f"session.{action}")[-1]
            assert (row["actor"], row["outcome"], row["session_id"]) == ("A. Therapist", "done", session_id)
            assert "body_not_read" not in row["detail"], "there is nothing in it that was needed"


def test_cancelling_a_qa_run_waits_for_no_body_either(client):
    headers = client.headers_as("A. Therapist")
    for name, (said, messages) in UNFINISHED.items():
        path = f"/api/v1/qa/runs/{'0' * 32}/cancel"
        assert status_of(client, path, headers | said, messages) == 404, name


def test_what_may_lead_to_a_permit_needs_its_body_whole(client, session_id, running, subtests):
    headers = client.headers_as("A. Therapist") | {"Content-Type": "application/json"}
    for name, (said, messages) in UNFINISHED.items():
        with subtests.test(name):
            ended = [*messages, {"type": "http.disconnect"}]
            assert status_of(client, f"/api/v1/sessions/{session_id}/arm", headers | said, ended) in {400, 413, 415}
            assert running.commands == []


@pytest.mark.parametrize("action", AWAY)
def test_a_machine_that_may_is_obeyed_and_acts_for_whom_it_legibly_states(client, begun, subtests, action):
    machine = by_key(client)
    for body, for_whom in FOR_WHOM.items():
        with subtests.test(str(body)):
            client.speaks_as = "A. Therapist"
            session_id, _ = begun()
            client.speaks_as = None
            answer = send(client, session_id, action, body, None, **machine)
            assert answer.status_code == 200, answer.text
            client.speaks_as = "A. Therapist"
            row = audit_rows(client, f"session.{action}")[-1]
            found = (row["actor"], row["session_id"], row["detail"].get("on_behalf_of"))
            assert found == ("key:tps", session_id, for_whom)


@pytest.mark.parametrize("action", AWAY)
def test_a_caller_without_the_permission_is_refused_with_any_body(client, session_id, running, action):
    client.headers_as("B. Viewer", {"viewer"})
    client.speaks_as = "B. Viewer"
    assert send(client, session_id, action, b"", None).status_code == 403
    foreign = send(client, session_id, action, b"", None, Origin="http://evil.example")
    assert (foreign.status_code, foreign.json()["code"]) == (403, "origin_refused")
    assert running.commands == []
    assert not running.status.is_over


@pytest.mark.parametrize("action", ["arm", "release", "acknowledge", "reference"])
def test_what_may_lead_to_a_permit_is_as_strict_as_ever(client, session_id, running, subtests, action):
    for name in ("no body", "the type of a form", "an unknown field", "a list"):
        with subtests.test(name):
            body, media_type, _ = UNREAD[name]
            assert send(client, session_id, action, body, media_type).status_code in {415, 422}
            assert running.commands == []


def test_cancelling_a_qa_run_minds_neither_body_nor_accept(client):
    url = f"/api/v1/qa/runs/{'0' * 32}/cancel?_=1"
    assert client.post(url, content=b"[", headers={"Accept": "image/png"}).json()["code"] == "not_found"


def test_a_claim_that_is_whole_leaves_nothing_unread():
    assert read_claim(b'{"operator": "C. Nurse"}') == ClaimedOperator(operator="C. Nurse", unread=None)
