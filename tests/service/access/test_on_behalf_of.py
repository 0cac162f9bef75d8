"""In whose name a call acts: the authenticated one; a machine's audit rows tell for whom."""

from datetime import timedelta

import pytest

from service.core.permissions import KEY_PERMISSIONS
from service.storage.audit import Event
from tests.support.service.accounts import headers_of, open_login
from tests.support.service.api_calls import make_calibration

JSON = {"Content-Type": "application/json"}


@pytest.fixture
def machine(anonymous):
    desk = anonymous.desk
    made = desk.keys.create("planning", KEY_PERMISSIONS, desk.store.now() + timedelta(days=1), by="test")
    return {"Authorization": f"Bearer {made.secret}", **JSON}


@pytest.fixture
def person(anonymous):
    return {**headers_of(open_login(anonymous.desk.store, "A. Therapist")), **JSON}


def upload(client, headers, operator=None):
    params = {} if operator is None else {"operator": operator}
    content = make_calibration(camera=str(operator)).to_json()
    return client.post("/api/v1/calibrations", params=params, content=content.encode(), headers=headers)


def rows(client, person, action):
    items = client.get("/api/v1/audit", headers=person).json()["items"]
    return [row for row in reversed(items) if row["action"] == action]


@pytest.fixture
def silent(anonymous, monkeypatch):
    """The client as it is: no one is guessed from a request's words."""
    monkeypatch.setattr("tests.support.service.accounts._named", lambda _options: None)
    return anonymous


def test_a_machine_is_the_actor_and_the_audit_reports_for_whom_it_acts(silent, machine, person):
    assert upload(silent, machine, "C. Nurse").json()["uploaded_by"] == "key:planning"
    assert upload(silent, machine).status_code == 201
    first, second = rows(silent, person, "calibration.upload")
    assert (first["actor"], first["detail"]["on_behalf_of"]) == ("key:planning", "C. Nurse")
    assert "on_behalf_of" not in second["detail"]
    assert all("on_behalf_of" not in row["detail"] for row in rows(silent, person, "service.start"))


def test_a_person_acts_in_their_own_name_or_in_none(silent, person):
    assert upload(silent, person).json()["uploaded_by"] == "A. Therapist"
    assert upload(silent, person, "A. Therapist").status_code in {200, 201}
    refused = upload(silent, person, "C. Nurse")
    assert (refused.status_code, refused.json()["code"]) == (422, "operator_mismatch")
    row = rows(silent, person, "calibration.upload")[-1]
    assert (row["actor"], row["outcome"], row["detail"]["code"]) == ("A. Therapist", "refused", "operator_mismatch")


@pytest.mark.parametrize("action", ["hold", "disarm", "stop"])
def test_what_takes_the_beam_away_is_not_refused_over_a_name(silent, person, action):
    url = f"/api/v1/sessions/{'0' * 32}/{action}"
    answer = silent.post(url, content=b'{"operator": "C. Nurse"}', headers=person)
    assert answer.json()["code"] == "not_found"
    other = silent.post(f"/api/v1/sessions/{'0' * 32}/arm", content=b'{"operator": "C. Nurse"}', headers=person)
    assert other.json()["code"] == "operator_mismatch"


def test_what_one_call_states_of_its_principal_no_other_call_has(silent, machine):
    upload(silent, machine, "C. Nurse")
    silent.desk.store.write(event=Event(actor="test", action="test.test"))
    from service.storage.audit import chain

    assert chain.audit_fields() == {}
