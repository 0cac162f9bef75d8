"""Whatever happens to a session, its patient is in no line of the log and in no metric."""

import logging

import pytest

from engine.core.gate_state import GateState, HoldReason
from service.core.logging.redaction import RedactingFormatter
from tests.support.service.api_calls import act, make_session_body
from tests.support.service.metrics import read
from tests.support.waiting import eventually

ABOUT = {"patient_reference": "ZZPATIENTZZ-1", "plan_id": "ZZPLANZZ-2", "fraction_id": "ZZFRACTIONZZ-3"}
OPERATOR = "Zz Operator Zz"
UNMISTAKABLE = (*ABOUT.values(), OPERATOR)


@pytest.fixture
def body(calibration_id):
    return {**make_session_body(calibration_id), **ABOUT, "operator": OPERATOR}


@pytest.fixture
def database_url():
    return None


def lines(caplog, capfd):
    printed = capfd.readouterr()
    ours = [record for record in caplog.records if not record.name.startswith("httpx2")]  # the tests' own client
    logged = [RedactingFormatter().format(record) for record in ours]
    return "\n".join([*logged, printed.out, printed.err])


def nothing_reported(client, caplog, capfd):
    read_back = f"{lines(caplog, capfd)}\n{client.get('/metrics').text}"
    assert not [word for word in UNMISTAKABLE if word.lower() in read_back.lower()], read_back
    return read_back


def test_a_session_from_its_start_to_its_end_is_in_no_log_and_no_metric(client, engine, body, caplog, capfd):
    caplog.set_level(logging.DEBUG)
    session_id = client.post("/api/v1/sessions", json=body).json()["id"]
    act(client, session_id, "start", OPERATOR)
    engine.running.frame()
    for action in ("reference", "arm", "hold", "release", "disarm", "acknowledge", "models/retrain"):
        act(client, session_id, action, OPERATOR)
    engine.running.transition(GateState.FAULT, HoldReason.WATCHDOG, operator=OPERATOR)
    client.get(f"/api/v1/sessions/{session_id}/samples")
    client.get("/api/v1/audit/export", params={"with_patients": True})
    act(client, session_id, "stop", OPERATOR)
    nothing_reported(client, caplog, capfd)


def test_refusals_that_show_the_patient_to_the_caller_show_no_other_patient(client, body, caplog, capfd):
    caplog.set_level(logging.DEBUG)
    client.post("/api/v1/sessions", json=body)
    for name, value in [*((name, value * 50) for name, value in ABOUT.items()), ("source", ABOUT["plan_id"])]:
        assert client.post("/api/v1/sessions", json={**body, name: value}).status_code in {409, 422}
    assert client.post("/api/v1/sessions", json=body).status_code == 409
    assert client.post("/api/v1/sessions", content=str(body), headers={"Content-Type": "text/plain"}).status_code == 415
    client.get(f"/api/v1/sessions/{ABOUT['patient_reference']}")
    nothing_reported(client, caplog, capfd)


def test_a_crash_while_a_session_is_made_or_runs_reports_its_kind_and_not_whom_it_was_about(
    client, engine, body, caplog, capfd, monkeypatch
):
    caplog.set_level(logging.DEBUG)

    def crash(*_):
        raise ValueError(f"of {body}")

    client_that_looks_on = type(client)(client.app, raise_server_exceptions=False)
    client_that_looks_on._logins = client._logins
    with monkeypatch.context() as patch:
        patch.setattr("service.sessions.records.sessions.session_answer", crash)
        answer = client_that_looks_on.post("/api/v1/sessions", json=body)
        assert answer.status_code == 500
        assert not [word for word in UNMISTAKABLE if word in answer.text]
    session_id = client.post("/api/v1/sessions", json=body).json()["id"]
    act(client, session_id, "start", OPERATOR)
    engine.running.end(error="the engine failed")
    eventually(lambda: read(client)["tidegate_session_running",] == 0.0)
    read_back = nothing_reported(client, caplog, capfd)
    assert "ValueError" in read_back
