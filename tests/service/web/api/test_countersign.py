"""A second person countersigns what would be armed: from an own log-in, or with name and password at another's page."""

from dataclasses import replace
from datetime import timedelta

import pytest

from engine.control.arming import CountersignatureState
from engine.core.commands import Countersign
from engine.core.errors import CountersignatureError
from service.access.request.identity import Identity
from service.core.errors import SignerError
from service.core.permissions import Role
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.site_limits.window_limits import gate_limits
from tests.support.service.accounts import PASSWORD, QuickHashing, open_login
from tests.support.service.api_calls import audit_rows
from tests.support.service.clinical_site import clinical_settings
from tests.support.service.fake_engine import make_model

STATE = "5e" * 16


@pytest.fixture
def measuring(running):
    """A session that measures, with a model and a reference, and whose first arming needs a second person."""
    running.model, running.has_reference = make_model(1), True
    running.countersignature = CountersignatureState(is_required=True)
    running.frame()
    return running


@pytest.fixture
def therapist(client, monkeypatch):
    """B. Therapist, with a password."""
    monkeypatch.setattr(client.desk.logins, "_hashing", QuickHashing())
    open_login(client.desk.store, "B. Therapist", [Role.THERAPIST])
    return {"name": "B. Therapist", "password": PASSWORD}


def countersign(client, session_id, **body):
    body = {"operator": "A. Therapist", "state": STATE, **body}
    return client.post(f"/api/v1/sessions/{session_id}/countersign", json=body)


def item(client, session_id):
    items = client.get(f"/api/v1/sessions/{session_id}/arming").json()["items"]
    return next((one for one in items if one["code"] == "countersignature"), None)


def test_it_is_missing_until_a_second_person_has_signed(client, session_id, measuring):
    assert item(client, session_id)["state"] == "missing"
    measuring.countersignature = CountersignatureState(is_required=True, signed_by="B. Therapist")
    assert item(client, session_id) == {
        "code": "countersignature",
        "state": "ok",
        "text": "B. Therapist; another person arms",
    }
    measuring.countersignature = CountersignatureState()
    assert item(client, session_id) is None


def test_who_is_logged_in_signs_and_the_audit_has_the_window(client, session_id, measuring):
    assert countersign(client, session_id).status_code == 200
    assert measuring.commands[-1] == Countersign(operator="A. Therapist", seen=STATE)
    row = audit_rows(client, "session.countersign")[-1]
    assert (row["actor"], row["outcome"]) == ("A. Therapist", "done")
    assert (row["detail"]["state"], row["detail"]["page_of"]) == (STATE, "A. Therapist")
    assert row["detail"]["window"][0]["lower"] == -1.0


def test_a_second_person_signs_with_a_password_at_anothers_page(client, session_id, measuring, therapist):
    before = len(client.desk.store.logins)
    assert countersign(client, session_id, **therapist).status_code == 200
    assert measuring.commands[-1].operator == "B. Therapist"
    row = audit_rows(client, "session.countersign")[-1]
    assert (row["actor"], row["detail"]["page_of"]) == ("B. Therapist", "A. Therapist")
    assert len(client.desk.store.logins) == before, "no log-in stays open"


@pytest.mark.parametrize("sent", [{"password": "guessed"}, {"name": "Nobody"}])
def test_a_wrong_password_signs_nothing_and_counts_as_a_failed_log_in(client, session_id, measuring, therapist, sent):
    before = len(measuring.commands)
    answers = [countersign(client, session_id, **{**therapist, **sent}) for _ in range(8)]
    assert (answers[0].status_code, answers[0].json()["code"]) == (422, "second_person")
    assert "guessed" not in answers[0].text
    assert (answers[-1].status_code, answers[-1].json()["code"]) == (429, "locked_out")
    assert len(measuring.commands) == before


def test_a_person_who_may_not_set_the_reference_does_not_countersign(client, session_id, measuring, therapist):
    open_login(client.desk.store, "V. Viewer", [Role.VIEWER])
    answer = countersign(client, session_id, name="V. Viewer", password=PASSWORD)
    assert (answer.status_code, answer.json()["code"]) == (422, "second_person")
    assert not any(isinstance(one, Countersign) for one in measuring.commands)


@pytest.mark.parametrize(
    "body", [{"name": "B. Therapist"}, {"password": PASSWORD}, {"state": None}, {"state": "5e"}, {"also": 1}]
)
def test_a_body_that_is_not_whole_is_refused_and_no_password_repeated(client, session_id, measuring, body):
    answer = countersign(client, session_id, **body)
    assert answer.status_code == 422
    assert PASSWORD not in answer.text


def test_what_the_engine_refuses_is_refused_by_code(client, session_id, measuring):
    measuring.refuse_with = CountersignatureError("look again")
    answer = countersign(client, session_id)
    assert (answer.status_code, answer.json()["code"]) == (409, "countersignature_missing")


@pytest.mark.parametrize(
    ("settings", "is_needed"),
    [
        (Settings(), False),
        (Settings(countersignature=True), True),
        (clinical_settings(), True),
        (clinical_settings(countersignature=False), False),
    ],
)
def test_it_is_the_rule_in_clinical_mode_and_where_a_site_wants_it(settings, is_needed):
    window = Window(signal="whole", lower_mm=-1.0, upper_mm=3.0, dwell_ms=250.0)
    assert gate_limits(window, settings).needs_countersignature is is_needed


def test_a_person_of_a_provider_signs_with_a_log_in_of_the_last_five_minutes(client):
    opened = open_login(client.desk.store, "O. Outside")
    user = replace(opened.user, issuer="https://provider.example", subject="1", password_hash=None)
    client.desk.store.write(save=[user])
    identity = Identity(kind="oidc", name="O. Outside", permissions=frozenset(), anchor=opened.login.token_sha256)
    assert client.desk.confirm_signer(identity, None, "127.0.0.1") == "login"
    client.desk.store.write(save=[replace(opened.login, created_at=opened.login.created_at - timedelta(minutes=6))])
    with pytest.raises(SignerError, match="log out and in again"):
        client.desk.confirm_signer(identity, None, "127.0.0.1")
