"""ETags say whether anything was decided since; a stale If-Match does nothing; the beam goes off whatever it says."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime, timedelta

import pytest

from engine.core.breath import Breath
from service.core.conditional import etag_of, is_known, precondition
from service.core.errors import BoundError, PreconditionFailedError
from service.sessions.records.etags import DECISIONS
from service.storage.audit.log import AuditLog
from service.web.api import models, sessions
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.fake_engine import REFUSED
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

STALE = '"00000000000000000000000000000000"'
V1 = "/api/v1"
GATED = ("start", "reference", "arm", "acknowledge", "release", "models/retrain", "models/apply")


def etag(client, path):
    answer = client.get(f"{V1}{path}")
    assert answer.status_code == 200, answer.text
    return answer.headers["ETag"]


def ask(client, session_id, action, tag, **body):
    return client.post(f"{V1}/sessions/{session_id}/{action}", json=body, headers={"If-Match": tag})


@pytest.mark.parametrize(
    "action", ["start", "reference", "arm", "acknowledge", "release", "models/retrain", "models/apply"]
)
def test_a_stale_precondition_does_nothing_names_the_present_state_and_is_audited(client, session_id, engine, action):
    if action != "start":
        act(client, session_id, "start")
        asked = len(engine.running.commands)
    now = etag(client, f"/sessions/{session_id}")
    answer = ask(client, session_id, action, STALE)
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["field"]) == (412, "precondition_failed", "If-Match")
    assert problem["bound"] == now
    assert etag(client, f"/sessions/{session_id}") == now
    assert audit_rows(client)[-1]["outcome"] == "refused"
    assert engine.opened == [] if action == "start" else len(engine.running.commands) == asked


@pytest.mark.both_databases
def test_a_present_precondition_is_done_and_makes_the_next_one_stale(client, session_id, running):
    first = etag(client, f"/sessions/{session_id}")
    assert ask(client, session_id, "arm", first).status_code == 200
    second = etag(client, f"/sessions/{session_id}")
    assert second != first
    assert ask(client, session_id, "reference", first).status_code == 412
    assert ask(client, session_id, "reference", f'"other", {second}').status_code == 200
    assert ask(client, session_id, "arm", "*").status_code == 200


@pytest.mark.parametrize("action", ["hold", "disarm", "stop"])
def test_what_takes_the_beam_away_is_done_whatever_is_asked_for(client, session_id, running, action):
    headers = {"If-Match": STALE, "Accept": "image/png"}
    answer = client.post(f"{V1}/sessions/{session_id}/{action}", json={}, headers=headers)
    assert answer.status_code == 200, answer.text


@pytest.mark.parametrize("action", ["hold", "disarm", "stop"])
def test_a_look_from_before_it_is_worth_nothing_from_when_the_engine_is_commanded_on(
    client, session_id, running, monkeypatch, action
):
    revisions, met = client.app.state.services.revisions, []
    before = revisions.etag(session_id)

    def looking(call):
        def look_and_call(*arguments, **named):
            with suppress(PreconditionFailedError), revisions.only_if(session_id, precondition(before)):
                met.append("a look from before was let through")
            met.append(revisions.etag(session_id))
            return call(*arguments, **named)

        return look_and_call

    monkeypatch.setattr(running, "submit", looking(running.submit))
    monkeypatch.setattr(running, "stop", looking(running.stop))
    monkeypatch.setattr(AuditLog, "write", looking(AuditLog.write))
    assert act(client, session_id, action).status_code == 200
    read_back, written = met
    after = revisions.etag(session_id)
    assert len({before, read_back, written, after}) == 4, "before, read back, done, recorded"
    assert revisions.etag(session_id) == after


def test_what_a_hold_that_came_to_nothing_leaves_is_another_etag_at_most(client, session_id, running):
    before = etag(client, f"/sessions/{session_id}")
    running.refuse_with = REFUSED
    assert act(client, session_id, "hold").status_code == 409
    after = etag(client, f"/sessions/{session_id}")
    assert (after != before, after) == (True, etag(client, f"/sessions/{session_id}"))


def test_frames_change_no_etag_and_a_running_session_is_never_left_out(client, session_id, running):
    running.frame()
    first = etag(client, f"/sessions/{session_id}")
    running.frame()
    answer = client.get(f"{V1}/sessions/{session_id}", headers={"If-None-Match": first})
    assert (answer.status_code, answer.headers["ETag"]) == (200, first)


def test_every_decision_changes_the_etag(client, session_id, engine):
    seen = [etag(client, f"/sessions/{session_id}")]
    for action in ("start", "reference", "arm", "hold", "release", "disarm", "models/retrain", "models/apply", "stop"):
        assert act(client, session_id, action).status_code in {200, 202}, action
        seen.append(etag(client, f"/sessions/{session_id}"))
    assert len(set(seen)) == len(seen)


def test_every_call_that_decides_about_a_session_is_among_the_decisions(client):
    routers = (sessions.router, models.router)
    names = {route.name for router in routers for route in router.routes if "." in route.name}
    assert names - {"session.note", "session.send", "session.signature"} == set(DECISIONS) - {"session.close"}, (
        "a session that is over is signed"
    )


def test_of_two_corrections_at_once_with_one_etag_one_is_done(client, session_id, running):
    running.breaths = (Breath(drift=1.5),)
    running.frame()
    tag = etag(client, f"/sessions/{session_id}")
    client.headers_as("A. Therapist")
    both = threading.Barrier(2)

    def correct(_number):
        both.wait(PATIENCE_S)
        return ask(client, session_id, "baseline-correction", tag, by_mm=0.5, drift_mm=1.5).status_code

    with ThreadPoolExecutor(2) as pool:
        assert sorted(pool.map(correct, range(2))) == [200, 412]


@pytest.mark.parametrize("kind", ["calibrations", "users", "keys", "qa/baseline", "sessions"])
def test_a_known_state_is_not_reported_again(client, calibration_id, session_id, kind):
    key = client.desk.keys.create("one", ["sessions.read"], datetime.now(UTC) + timedelta(days=1), by="test").key
    ids = {"calibrations": calibration_id, "users": "A. Therapist", "keys": key.id, "sessions": session_id}
    path = f"/{kind}/{ids[kind]}" if kind in ids else f"/{kind}"
    tag = etag(client, path)
    for known in (tag, f"W/{tag}", f'"x", {tag}', "*"):
        answer = client.get(f"{V1}{path}", headers={"If-None-Match": known})
        assert (answer.status_code, answer.content, answer.headers["ETag"]) == (304, b"", tag)
    assert client.get(f"{V1}{path}", headers={"If-None-Match": STALE}).status_code == 200


def test_two_administrators_do_not_undo_each_other(client):
    client.headers_as("B. Viewer", {"viewer"})
    tag = etag(client, "/users/B. Viewer")
    first = client.patch(f"{V1}/users/B. Viewer", json={"is_break_glass": True}, headers={"If-Match": tag})
    assert (first.status_code, first.headers["ETag"]) == (200, etag(client, "/users/B. Viewer"))
    second = client.patch(f"{V1}/users/B. Viewer", json={"roles": ["admin"]}, headers={"If-Match": tag})
    assert (second.status_code, second.json()["code"]) == (412, "precondition_failed")
    assert client.get(f"{V1}/users/B. Viewer").json()["roles"] == ["viewer"]


def test_two_physicists_do_not_overwrite_each_other_s_baseline(client):
    tag = etag(client, "/qa/baseline")
    body = {"reason": "mounted anew", "expected": {"camera_distance_mm": 850.0}}
    first = client.put(f"{V1}/qa/baseline", json=body, headers={"If-Match": tag})
    assert (first.status_code, first.headers["ETag"]) == (200, etag(client, "/qa/baseline"))
    assert client.put(f"{V1}/qa/baseline", json=body, headers={"If-Match": tag}).status_code == 412
    assert client.get(f"{V1}/qa/baseline").json()["number"] == 1


@pytest.mark.parametrize("header", ["abc", '"a" "b"', '"a",', "W/", '"a\x01"', "**"])
def test_what_is_no_etag_is_refused_by_name(header):
    with pytest.raises(BoundError, match="If-Match"):
        precondition(header)


def test_a_weak_tag_states_nothing_about_a_change_and_enough_about_an_answer():
    tag = etag_of("x")
    with pytest.raises(PreconditionFailedError):
        precondition(f"W/{tag}").require(tag)
    assert is_known(f"W/{tag}", tag)
    precondition(None).require(tag)


def test_etags_tell_things_apart():
    assert len({etag_of(), etag_of(""), etag_of("a", "b"), etag_of("ab"), etag_of("a", None), etag_of("a", 1)}) == 6
