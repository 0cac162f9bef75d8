"""The simulation day of a plan over the API: a session or a file of the same patient, signed by a person."""

import base64

import pytest

from service.core.permissions import Role
from service.exchange.dicom import waveform
from tests.support.exchange.breaths import PERIOD_S
from tests.support.exchange.session_curve import breathing_curve, subject
from tests.support.repository import ROOT
from tests.support.service.accounts import PASSWORD, QuickHashing, headers_of, open_login
from tests.support.service.api_calls import act, audit_rows, make_session_body

URL = "/api/v1/sessions"
SIGNER = "P. Physicist"
REAL = next((ROOT / "tests/data/rpm").glob("*.vxp"))


@pytest.fixture
def headers(client, monkeypatch):
    monkeypatch.setattr(client.desk.logins, "_hashing", QuickHashing())
    return headers_of(open_login(client.desk.store, SIGNER, [Role.PHYSICIST]))


def signed(client, at, headers, **body):
    body = {"operator": SIGNER, "password": PASSWORD, **body}
    return client.post(f"{URL}/{at}/simulation", json=body, headers=headers)


def encoded(content: bytes) -> str:
    return base64.b64encode(content).decode()


@pytest.fixture
def earlier(client, session_id, monkeypatch):
    """Another session of the patient, over, with breaths; its window is -1 to 3 mm."""
    monkeypatch.setattr(client.app.state.services.exports, "curve", lambda _: breathing_curve())
    assert act(client, session_id, "start").status_code == 200
    assert act(client, session_id, "stop").status_code == 200
    return session_id


@pytest.fixture
def today(client, earlier, calibration_id):
    body = make_session_body(calibration_id) | {"fraction_id": "FX-9", "fraction_number": 9}
    return client.post(URL, json=body).json()["id"]


def test_a_session_states_its_breath_and_its_window_in_per_cent(client, headers, earlier, today):
    answer = signed(client, today, headers, session_id=earlier)
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert (found["origin"], found["session_id"], found["of_session"]) == ("session", earlier, today)
    assert found["period_s"] == pytest.approx(PERIOD_S, abs=0.02)
    assert (found["end_exhale_mm"], found["end_inhale_mm"]) == pytest.approx((2.0, 10.0), abs=0.02)
    assert found["window_from"] == "window"
    assert (found["lower_percent"], found["upper_percent"]) == pytest.approx((-37.5, 12.5), abs=0.5)
    assert (found["signed_by"], found["confirmed_by"]) == (SIGNER, "password")
    assert 390 <= len(found["trace"]) <= 400
    assert client.get(f"{URL}/{today}/simulation").json() == found
    row = audit_rows(client, "session.simulation")[-1]
    assert (row["actor"], row["outcome"], row["session_id"]) == (SIGNER, "done", today)
    assert row["detail"]["session_id"] == earlier


def test_another_tidegate_s_waveform_states_the_levels_with_the_beam_on(client, headers, today):
    raw = waveform(subject(), breathing_curve())
    found = signed(client, today, headers, file=encoded(raw), signal="abdomen").json()
    assert (found["origin"], found["window_from"], found["has_position"]) == ("dicom", "beam", False)
    assert (found["lower_percent"], found["upper_percent"]) == pytest.approx((20.0, 50.0), abs=2.0)
    assert found["begun_at"] == "2026-11-27T09:30:00.250000Z"
    refused = signed(client, today, headers, file=encoded(raw), signal="whole").json()
    assert (refused["field"], refused["bound"]) == ("signal", "thorax or abdomen of waveform.dcm")
    assert PASSWORD not in str(audit_rows(client, "session.simulation"))


def test_a_vxp_of_the_patient_is_taken(client, headers, today):
    content = REAL.read_bytes().replace(b"Patient_ID=PT01", b"Patient_ID=p-0001 ")
    found = signed(client, today, headers, file=encoded(content)).json()
    assert (found["origin"], found["window_from"], found["lower_percent"]) == ("vxp", "none", None)
    assert 2.0 < found["period_s"] < 8.0
    assert found["trace"][-1][0] == pytest.approx(59.9, abs=0.2)


def test_later_sessions_of_the_plan_have_it_and_those_of_another_plan_do_not(
    client, headers, earlier, today, calibration_id
):
    found = signed(client, today, headers, session_id=earlier).json()
    for changes, status in (({"fraction_id": "FX-10"}, 200), ({"plan_id": "PLAN-2"}, 404)):
        act(client, today, "start")
        act(client, today, "stop")
        today = client.post(URL, json=make_session_body(calibration_id) | changes).json()["id"]
        answer = client.get(f"{URL}/{today}/simulation")
        assert answer.status_code == status
        assert status == 404 or answer.json() == found
    assert client.get(f"{URL}/{earlier}/simulation").status_code == 404, "it was before"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (REAL.read_bytes(), "patient"),
        (waveform(subject(patient_id="P-0002"), breathing_curve()), "patient"),
        (waveform(subject().deidentified("ANON"), breathing_curve()), "patient"),
        (waveform(subject(), breathing_curve())[:900], "waveform.dcm"),
        (b"[Header]\nCRC=1\n", "vxp"),
        (b"0 0 0 0 0 0 0\n" * 20, "vxp"),
        (b"", "vxp"),
    ],
    ids=["other-vxp", "other-dicom", "no-patient", "cut", "head-only", "qa-text", "empty"],
)
def test_what_is_another_s_or_none_is_refused_in_a_row_that_names_nobody(client, headers, today, content, said):
    answer = signed(client, today, headers, file=encoded(content))
    assert (answer.status_code, answer.json()["field"]) == (422, "file"), answer.text
    assert said in answer.json()["detail"]
    assert client.get(f"{URL}/{today}/simulation").status_code == 404
    assert not [row for row in audit_rows(client, "session.simulation") if row["outcome"] == "done"]
    row = audit_rows(client, "session.simulation")[-1]
    assert row["outcome"] == "refused"
    assert "P-0002" not in str(row)


@pytest.mark.parametrize(
    ("body", "status", "field"),
    [
        ({}, 422, "session_id"),
        ({"session_id": "5e" * 16, "file": "AAAA"}, 422, "session_id"),
        ({"session_id": "5e" * 16}, 404, "session_id"),
        ({"file": "no base64!"}, 422, "file"),
        ({"file": "A" * 4_000_004}, 422, "file"),
        ({"file": "AAAA", "signal": "chest"}, 422, "signal"),
        ({"file": "AAAA", "password": "not the password"}, 422, "password"),
    ],
)
def test_a_wrong_body_is_refused_by_its_field(client, headers, session_id, body, status, field):
    answer = signed(client, session_id, headers, **body)
    assert (answer.status_code, answer.json()["field"]) == (status, field), answer.text


def test_another_patient_s_session_and_a_started_one_are_refused(client, headers, earlier, calibration_id):
    other = client.post(URL, json=make_session_body(calibration_id) | {"patient_reference": "P-0002"}).json()["id"]
    answer = signed(client, other, headers, session_id=earlier)
    assert (answer.status_code, answer.json()["field"]) == (422, "session_id")
    act(client, other, "start")
    answer = signed(client, other, headers, session_id=earlier)
    assert (answer.status_code, answer.json()["code"]) == (409, "session_state")
