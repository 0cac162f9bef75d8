"""Lists: pages that leave nothing out, cursors that cannot be bent, filters, and no parameter that is not known."""

import base64
from datetime import UTC, datetime

import pytest

from engine.core.gate_state import GateState, HoldReason
from tests.support.service.api_calls import act, make_calibration, upload
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

V1 = "/api/v1"
LISTS = ("/sessions", "/calibrations", "/audit", "/qa/runs", "/plans", "/users", "/keys", "/devices", "/recordings")


def get(client, path, **params):
    answer = client.get(f"{V1}{path}", params=params)
    assert answer.status_code == 200, answer.text
    return answer


def refused(client, path, **params):
    answer = client.get(f"{V1}{path}", params=params)
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_value"), answer.text
    return answer.json()


@pytest.fixture
def cameras(client):
    for number in range(7):
        upload(client, make_calibration(f"camera {number % 2}{number}").to_json())
    return [item["id"] for item in get(client, "/calibrations", limit=100).json()["items"]]


@pytest.mark.both_databases
def test_links_lead_through_all_pages_though_more_is_added_meanwhile(client, cameras):
    answer, seen = get(client, "/calibrations", limit=3), []
    while True:
        seen += [item["id"] for item in answer.json()["items"]]
        upload(client, make_calibration(f"added behind {len(seen)}").to_json())
        if answer.json()["next_cursor"] is None:
            assert "Link" not in answer.headers
            break
        link = answer.headers["Link"]
        assert link.endswith('>; rel="next"')
        answer = client.get(link[1:].partition(">")[0])
    assert seen == cameras


def test_a_cursor_is_of_one_list_with_its_filters_and_not_to_be_bent(client, cameras):
    cursor = get(client, "/calibrations", limit=2).json()["next_cursor"]
    content = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
    bent = base64.urlsafe_b64encode(content[:-1] + bytes([content[-1] ^ 1])).decode().rstrip("=")
    for wrong in (bent, cursor[:-2], cursor + "A", "", "2026-01-01T00:00:00Z_" + "0" * 32, "\u2603", "x" * 200):
        assert refused(client, "/calibrations", cursor=wrong)["field"] == "cursor"
    assert refused(client, "/sessions", cursor=cursor)["field"] == "cursor"
    assert refused(client, "/calibrations", cursor=cursor, camera="camera 00")["field"] == "cursor"
    assert len(get(client, "/calibrations", cursor=cursor, limit=4).json()["items"]) == 4


@pytest.mark.parametrize("path", LISTS)
def test_what_a_list_does_not_know_is_refused_by_name(client, path):
    problem = refused(client, path, limt=3)
    assert (problem["field"], problem["value"]) == ("limt", "'given'")


def test_a_parameter_that_is_given_twice_is_refused(client):
    answer = client.get(f"{V1}/sessions?limit=3&limit=4")
    assert (answer.status_code, answer.json()["field"]) == (422, "limit")


@pytest.mark.both_databases
def test_sessions_are_found_by_patient_plan_state_and_time(client, session_body):
    before = datetime.now(UTC).isoformat()
    for patient, plan in (("P-1", "A"), ("P-1", "B"), ("P-2", "B")):
        body = session_body | {"patient_reference": patient, "plan_id": plan}
        act(client, client.post(f"{V1}/sessions", json=body).json()["id"], "stop")
    client.post(f"{V1}/sessions", json=session_body)

    def found(**params):
        return [
            (one["patient_reference"], one["plan_id"]) for one in get(client, "/sessions", **params).json()["items"]
        ]

    assert found(patient_reference="P-1") == [("P-1", "B"), ("P-1", "A")]
    assert found(plan_id="B", patient_reference="P-2") == [("P-2", "B")]
    assert found(status="created") == [("P-0001", "PLAN-1")]
    assert len(found(since=before)) == 4
    assert found(until=before) == []
    assert refused(client, "/sessions", status="open")["field"] == "status"
    assert refused(client, "/sessions", since="yesterday")["field"] == "since"


@pytest.mark.both_databases
def test_the_audit_is_found_by_action_actor_outcome_and_time(client, session_body):
    client.post(f"{V1}/sessions", json=session_body | {"fraction_number": 0})
    client.post(f"{V1}/sessions", json=session_body | {"operator": "B. Physicist"})

    def found(**params):
        return [(one["actor"], one["outcome"]) for one in get(client, "/audit", **params).json()["items"]]

    assert found(action="session.create") == [("B. Physicist", "done"), ("A. Therapist", "refused")]
    assert found(action="session.create", outcome="refused") == [("A. Therapist", "refused")]
    assert found(actor="B. Physicist") == [("B. Physicist", "done")]
    assert found(until="2020-01-01T00:00:00Z") == []
    assert len(found(since="2020-01-01T00:00:00+02:00", limit=500)) == len(found(limit=500))


@pytest.mark.both_databases
@pytest.mark.both_databases
def test_transitions_are_found_by_state_and_reason(client, session_id, running):
    running.transition(GateState.HOLD, HoldReason.MARKER_LOST)
    running.transition(GateState.BEAM_ON)
    running.transition(GateState.HOLD, HoldReason.OUTSIDE_WINDOW)
    path = f"/sessions/{session_id}/transitions"
    eventually(lambda: len(get(client, path).json()["items"]) == 3)

    def found(**params):
        return [(one["to_state"], one["reason"]) for one in get(client, path, **params).json()["items"]]

    assert found(to_state="beam_on") == [("beam_on", None)]
    assert found(reason="marker_lost") == [("hold", "marker_lost")]
    assert found(to_state="beam_on", reason="marker_lost") == []
    assert refused(client, path, reason="markerXlost")["field"] == "reason"


def test_calibrations_are_found_by_camera(client, cameras):
    assert [one["camera"] for one in get(client, "/calibrations", camera="camera 11").json()["items"]] == ["camera 11"]
