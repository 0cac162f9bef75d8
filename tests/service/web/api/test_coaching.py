"""Coaching over HTTP: pairing with a cookie of its own, strict settings, and no word of a patient in the stream."""

import json
import re

import pytest
from starlette.websockets import WebSocketDisconnect

from engine.core.breath import WHOLE
from engine.core.gate_state import GateState, HoldReason
from service.core.schemas.coaching import COACH_MESSAGE, CoachGuide
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.guided_patient import LEARNED

V1 = "/api/v1"
LIVE = f"{V1}/coach/live"


@pytest.fixture
def coaching(client, session_id, running):
    running.learned_ranges = {WHOLE: LEARNED}
    running.frame()
    return f"{V1}/sessions/{session_id}/coaching"


def paired_cookie(client):
    code = client.post(f"{V1}/coach/code", json={}).json()["code"]
    answer = client.post(f"{V1}/coach/pair", json={"code": code})
    assert answer.status_code == 204, answer.text
    (cookie,) = [one for one in answer.headers.get_list("set-cookie") if one.startswith("tidegate_screen=")]
    client.cookies.clear()
    return cookie


def test_a_screen_is_paired_listed_and_ended(client):
    cookie = paired_cookie(client)
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))
    sent = {"Cookie": cookie.partition(";")[0]}
    client.speaks_as = None
    me = client.get(f"{V1}/coach/me", headers=sent)
    assert (me.status_code, me.json()["is_screen"]) == (200, True)
    assert client.get(f"{V1}/me", headers=sent).status_code == 401
    client.speaks_as = "A. Therapist"
    (screen,) = client.get(f"{V1}/coach/screens").json()["items"]
    assert (screen["number"], screen["paired_by"]) == (1, "A. Therapist")
    assert client.post(f"{V1}/coach/screens/{screen['id']}/end", json={}).json()["items"] == []
    client.speaks_as = None
    assert client.get(f"{V1}/coach/me", headers=sent).status_code == 401


def test_a_wrong_code_is_refused_and_not_repeated_in_the_answer(client):
    client.post(f"{V1}/coach/code", json={})
    client.speaks_as = None
    for code, status in (("000000", 403), ("12345", 422), ("12a456", 422), (123456, 422)):
        answer = client.post(f"{V1}/coach/pair", json={"code": code})
        assert answer.status_code == status
        assert "value" not in answer.json()
        assert "set-cookie" not in answer.headers
    answer = client.post(f"{V1}/coach/pair", json={"code": "000000", "further": 1})
    assert (answer.status_code, answer.json()["field"]) == (422, "further")


def test_a_page_of_another_origin_pairs_nothing(client):
    code = client.post(f"{V1}/coach/code", json={}).json()["code"]
    client.speaks_as = None
    answer = client.post(f"{V1}/coach/pair", json={"code": code}, headers={"Origin": "http://elsewhere"})
    assert (answer.status_code, answer.json()["code"]) == (403, "origin_refused")


def test_settings_are_stored_returned_and_audited(client, coaching):
    wanted = {"display": "curve", "language": "de", "rest_s": 5.0, "sounds": True}
    answer = client.put(coaching, json={**wanted, "operator": "A. Therapist"})
    assert answer.status_code == 200, answer.text
    assert wanted.items() <= answer.json().items()
    assert client.get(coaching).json() == answer.json()
    (row,) = audit_rows(client, "coaching.set")
    assert (row["actor"], row["outcome"], row["detail"]["after"]["language"]) == ("A. Therapist", "done", "de")


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"display": "dial"}, "display"),
        ({"language": "fr"}, "language"),
        ({"sounds": 1}, "sounds"),
        ({"rest_s": -0.1}, "rest_s"),
        ({"rest_s": 120.1}, "rest_s"),
        ({"band": {"lower_percent": 0.0}}, "band.upper_percent"),
        ({"band": {"lower_percent": -100.1, "upper_percent": 50.0}}, "band.lower_percent"),
        ({"band": {"lower_percent": 0.0, "upper_percent": 300.1}}, "band.upper_percent"),
        ({"band": {"lower_percent": 50.0, "upper_percent": 54.9}}, "band.upper_percent"),
        ({"band": {"lower_percent": 60.0, "upper_percent": 40.0}}, "band.upper_percent"),
        ({"scale": {"lower_percent": 0.0, "upper_percent": 19.9}}, "scale.upper_percent"),
        (
            {
                "band": {"lower_percent": -10.0, "upper_percent": 50.0},
                "scale": {"lower_percent": 0.0, "upper_percent": 100.0},
            },
            "band",
        ),
        ({"gain": 2.0}, "gain"),
    ],
)
def test_what_is_out_of_its_bounds_is_refused_by_name_and_changes_nothing(client, coaching, body, field):
    before = client.get(coaching).json()
    answer = client.put(coaching, json=body)
    assert (answer.status_code, answer.json()["field"]) == (422, field), answer.text
    assert client.get(coaching).json() == before


def test_a_band_without_a_known_range_is_refused_and_the_refusal_audited(client, coaching, running):
    running.learned_ranges = {}
    answer = client.put(coaching, json={"band": {"lower_percent": 0.0, "upper_percent": 50.0}})
    assert (answer.status_code, answer.json()["field"]) == (422, "band")
    (row,) = audit_rows(client, "coaching.set")
    assert row["outcome"] == "refused"


def test_a_session_that_does_not_run_has_no_coaching(client, coaching, session_id):
    act(client, session_id, "stop")
    for answer in (client.get(coaching), client.put(coaching, json={})):
        assert (answer.status_code, answer.json()["code"]) == (409, "session_state")
    assert client.get(f"{V1}/sessions/{'0' * 32}/coaching").status_code == 404


def test_arming_ends_a_practice_and_practice_is_refused_while_armed(client, coaching, session_id, running):
    assert client.put(coaching, json={"is_practice": True}).json()["is_practice"] is True
    assert act(client, session_id, "arm").status_code == 200
    assert client.get(coaching).json()["is_practice"] is False
    running.frame()
    answer = client.put(coaching, json={"is_practice": True})
    assert (answer.status_code, answer.json()["field"]) == (409, "is_practice")


def test_no_setting_reaches_the_engine(client, coaching, running):
    before = list(running.commands)
    for body in ({"is_practice": True}, {"rest_s": 0.0}, {"band": {"lower_percent": 0.0, "upper_percent": 90.0}}):
        assert client.put(coaching, json=body).status_code == 200
    paired_cookie(client)
    assert running.commands == before


def watch(client, **headers):
    return client.websocket_connect(LIVE, headers=headers)


def guide_of(socket):
    for _ in range(200):
        message = COACH_MESSAGE.validate_json(socket.receive_text())
        if isinstance(message, CoachGuide):
            return message
    raise AssertionError("no guidance came")


def test_a_paired_screen_sees_places_words_and_nothing_that_names_or_measures(client, coaching, session_id, running):
    sent = paired_cookie(client).partition(";")[0]
    running.gate, running.reason = GateState.HOLD, HoldReason.OUTSIDE_WINDOW
    client.speaks_as = None
    running.frame(whole_mm=7.125)
    with watch(client, Cookie=sent) as socket:
        hello = socket.receive_json()
        assert hello == {"type": "hello", "schema": "tidegate.coach/1"}
        found = guide_of(socket)
    text = found.model_dump_json()
    assert 0.0 < found.level < 1.0
    assert found.instruction == "breathe_freely"
    for secret in ("P-0001", "PLAN-1", "FX-3", "Therapist", session_id, "7.125", "7.13", "mm"):
        assert secret not in text
    assert json.loads(text).keys() == {
        *("type", "sequence", "sent_at", "age_ms", "is_practice", "is_measured", "level", "band", "instruction"),
        *("countdown_s", "display", "sounds", "language"),
    }


def read_on(socket):
    """Read what was sent before the end, and the end."""
    for _ in range(1000):
        socket.receive_text()


def test_no_one_watches_without_a_pairing_and_an_ended_one_is_closed(client, coaching):
    sent = paired_cookie(client).partition(";")[0]
    client.speaks_as = None
    with pytest.raises(WebSocketDisconnect) as refused, watch(client) as socket:
        socket.receive_json()
    assert refused.value.code == 1008
    with watch(client, Cookie=sent) as socket:
        assert socket.receive_json()["type"] == "hello"
        desk = client.desk.screens
        ((screen, _),) = desk.all()
        desk.end(screen.id, by="test")
        with pytest.raises(WebSocketDisconnect) as closed:
            read_on(socket)
    assert closed.value.code == 1008


def test_while_nothing_is_armed_a_screen_waits(client, coaching):
    sent = paired_cookie(client).partition(";")[0]
    client.speaks_as = None
    with watch(client, Cookie=sent) as socket:
        messages = [socket.receive_json() for _ in range(4)]
    assert [one["type"] for one in messages] == ["hello", "wait", "wait", "wait"]
    assert not re.search("level|session|patient", json.dumps(messages))


def test_the_page_is_served_to_a_screen_that_is_not_paired_yet(client):
    client.speaks_as = None
    answer = client.get("/patient")
    assert (answer.status_code, answer.url.path) == (200, "/patient/")
    assert "style-src" not in answer.headers["content-security-policy"]
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    for path in set(re.findall(r'(?:src|href)="\.\./([^"]+)"', answer.text)):
        assert client.get(f"/{path}").status_code == 200, path
    assert not re.search(r"<style|<script>|style=|onclick", answer.text)
