"""A later fraction is compared with the plan's position; a person signs it by name, and no key does."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

from engine.control.fraction_checks import PositionState, Signature
from engine.core.commands import SignPosition
from engine.core.errors import PositionUncheckedError
from engine.core.learning_status import LearningEvent, LearningEventKind
from engine.core.position_check import PositionCheck, PositionTolerance
from engine.core.reference import NODES, FirstReference, ReferenceMoment
from service.core.permissions import KEY_PERMISSIONS, ROLE_PERMISSIONS, Permission, Role
from tests.support.exchange.session_curve import breathing_curve
from tests.support.service.accounts import PASSWORD, QuickHashing, headers_of, open_login
from tests.support.service.api_calls import act, audit_rows, make_session_body
from tests.support.waiting import eventually

URL = "/api/v1/sessions"
PLAN = FirstReference(
    calibration_sha256="c" * 64,
    layout_sha256="d" * 64,
    regions_mm=np.full(115, 850.25),
    surface_mm=np.full((NODES, 3), 850.5),
    plane_mm=850.0,
    volume_l=0.5,
    moment=ReferenceMoment.END_EXHALE,
)
TOLERANCE = PositionTolerance(shift_mm=2.0, turn_deg=1.0, shape_mm=2.0)
CHECK = PositionCheck(
    shift_mm=(0.5, 2.4, -0.7),
    turn_deg=(0.1, 0.2, -0.3),
    shift_uncertainty_mm=(1.2, 0.5, 0.1),
    turn_uncertainty_deg=(0.1, 0.2, 0.3),
    shape_mm=0.6,
)
UNSIGNED = PositionState(is_required=True, reference_number=1, check=CHECK, tolerance=TOLERANCE)
SIGN = {"operator": "A. Therapist", "reference_number": 1}


def begun(client, engine, calibration_id, **changes):
    """Start a session; return its id and what its engine was given."""
    session_id = client.post(URL, json=make_session_body(calibration_id) | changes).json()["id"]
    assert act(client, session_id, "start").status_code == 200
    return session_id, engine.running.plan


@pytest.fixture
def first_fraction(client, engine, calibration_id):
    """The plan's first fraction, in which a reference was confirmed."""
    session_id, plan = begun(client, engine, calibration_id)
    assert plan.plan_position is None
    kind = LearningEventKind.REFERENCE_SET
    engine.running.notices.put_nowait(LearningEvent(kind=kind, detail="", timestamp_us=7, figures={}, first=PLAN))
    eventually(lambda: audit_rows(client, "model.reference_set"))
    act(client, session_id, "stop")
    return session_id


@pytest.mark.both_databases
def test_a_later_fraction_of_the_plan_gets_its_position(client, engine, calibration_id, first_fraction):
    session_id, plan = begun(client, engine, calibration_id, fraction_id="FX-4", fraction_number=4)
    assert np.array_equal(plan.plan_position.surface_mm, PLAN.surface_mm)
    assert (plan.plan_position.moment, plan.plan_session_id) == (ReferenceMoment.END_EXHALE, first_fraction)
    assert plan.first_reference is None
    started = audit_rows(client, "session.start")[-1]
    assert (started["session_id"], started["detail"]["position_of_session"]) == (session_id, first_fraction)


@pytest.mark.both_databases
def test_the_simulation_day_s_position_is_the_plan_s_from_the_first_fraction_on(
    client, engine, calibration_id, first_fraction, monkeypatch
):
    monkeypatch.setattr(client.desk.logins, "_hashing", QuickHashing())
    monkeypatch.setattr(client.app.state.services.exports, "curve", lambda _: breathing_curve())
    other = make_session_body(calibration_id) | {"plan_id": "PLAN-2"}
    for fraction in ("FX-1", "FX-2"):
        session_id = client.post(URL, json=other | {"fraction_id": fraction}).json()["id"]
        if fraction == "FX-1":
            body = {"operator": "A. Therapist", "session_id": first_fraction, "password": PASSWORD}
            signed = client.post(f"{URL}/{session_id}/simulation", json=body)
            assert signed.json()["has_position"], signed.text
        assert act(client, session_id, "start").status_code == 200
        plan = engine.running.plan
        assert np.array_equal(plan.plan_position.surface_mm, PLAN.surface_mm)
        assert plan.plan_session_id == first_fraction
        act(client, session_id, "stop")


@pytest.mark.parametrize(
    ("other", "is_compared"),
    [
        ({}, False),  # the first fraction itself, continued
        ({"fraction_number": None}, False),
        ({"fraction_number": 4}, True),
        ({"fraction_id": "FX-4"}, True),
        ({"fraction_id": "FX-4", "fraction_number": None}, True),
        ({"fraction_id": "FX-4", "patient_reference": "P-0002"}, False),
        ({"fraction_id": "FX-4", "plan_id": "PLAN-2"}, False),
    ],
)
def test_only_another_fraction_of_the_same_patient_and_plan_is_compared(
    client, engine, calibration_id, first_fraction, other, is_compared
):
    assert first_fraction
    _, plan = begun(client, engine, calibration_id, **other)
    assert (plan.plan_position is not None) == is_compared


def test_the_first_fraction_stays_the_plans_whatever_later_ones_confirm(client, engine, calibration_id, first_fraction):
    session_id, _ = begun(client, engine, calibration_id, fraction_id="FX-4")
    moved = replace(PLAN, surface_mm=PLAN.surface_mm + 30.0)
    kind = LearningEventKind.REFERENCE_SET
    engine.running.notices.put_nowait(LearningEvent(kind=kind, detail="", timestamp_us=7, figures={}, first=moved))
    eventually(lambda: len(audit_rows(client, "model.reference_set")) == 2)
    act(client, session_id, "stop")
    for fraction in ("FX-4", "FX-5"):
        session_id, plan = begun(client, engine, calibration_id, fraction_id=fraction)
        assert plan.plan_session_id == first_fraction
        assert np.array_equal(plan.plan_position.surface_mm, PLAN.surface_mm)
        act(client, session_id, "stop")


def test_a_person_signs_and_the_audit_has_the_figures(client, session_id, running):
    running.frame()
    running.latest = replace(running.latest, position=UNSIGNED)
    body = SIGN | {"reason": "longitudinal by the lasers"}
    assert client.post(f"{URL}/{session_id}/position-check", json=body).status_code == 200
    assert running.commands[-1] == SignPosition(
        operator="A. Therapist", reference_number=1, reason="longitudinal by the lasers", may_exceed=True
    )
    row = audit_rows(client, "session.position_check")[-1]
    assert (row["actor"], row["outcome"]) == ("A. Therapist", "done")
    assert row["detail"]["reference_number"] == 1
    shown = row["detail"]["shown"]
    assert [one["value"] for one in shown["degrees"]] == [None, 2.4, -0.7, 0.1, 0.2, -0.3]
    assert shown["shortcomings"] == ["lateral not determined", "longitudinal +2.4 mm"]


def test_no_key_signs(client, session_id, running):
    running.frame()
    client.speaks_as = None
    desk = client.desk
    made = desk.keys.create("planning", KEY_PERMISSIONS, desk.store.now() + timedelta(days=1), by="test")
    headers = {"Authorization": f"Bearer {made.secret}"}
    answer = client.post(f"{URL}/{session_id}/position-check", json={"reference_number": 1}, headers=headers)
    assert answer.status_code == 403
    assert not any(isinstance(command, SignPosition) for command in running.commands)


def test_without_a_log_in_nothing_is_signed(client, session_id, running, monkeypatch):
    running.frame()
    monkeypatch.setattr("tests.support.service.accounts._named", lambda _options: None)
    client.speaks_as = None
    assert client.post(f"{URL}/{session_id}/position-check", json=SIGN).status_code == 401
    ended = open_login(client.desk.store, "A. Therapist", [Role.THERAPIST])
    client.desk.logins.log_out(ended.login)
    assert client.post(f"{URL}/{session_id}/position-check", json=SIGN, headers=headers_of(ended)).status_code == 401
    assert not any(isinstance(command, SignPosition) for command in running.commands)


def test_a_signature_in_the_name_of_another_is_refused(client, session_id, running, monkeypatch):
    running.frame()
    monkeypatch.setattr("tests.support.service.accounts._named", lambda _options: None)
    answer = client.post(f"{URL}/{session_id}/position-check", json=SIGN | {"operator": "Someone Else"})
    assert (answer.status_code, answer.json()["code"]) == (422, "operator_mismatch")
    assert not any(isinstance(command, SignPosition) for command in running.commands)


def test_who_may_sign():
    assert Permission.GATE_REFERENCE not in KEY_PERMISSIONS
    assert {role for role, may in ROLE_PERMISSIONS.items() if Permission.GATE_REFERENCE in may} == {
        Role.THERAPIST,
        Role.PHYSICIST,
    }


def test_a_refusal_is_a_problem_and_is_audited(client, session_id, running):
    running.frame()
    running.refuse_with = PositionUncheckedError("the patient moved: set the reference again")
    for path, body in (("position-check", SIGN), ("arm", {"operator": "A. Therapist", "head_direction": "top"})):
        answer = client.post(f"{URL}/{session_id}/{path}", json=body)
        assert (answer.status_code, answer.json()["code"]) == (409, "position_unchecked")
        assert "set the reference again" in answer.json()["detail"]
        assert audit_rows(client)[-1]["outcome"] == "refused"


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "reference_number"),
        ({"reference_number": 0}, "reference_number"),
        ({"reference_number": "1"}, "reference_number"),
        ({"reference_number": 1, "reason": "x" * 201}, "reason"),
        ({"reference_number": 1, "because": "x"}, "because"),
    ],
)
def test_what_is_out_of_bounds_is_refused_by_name(client, session_id, running, body, field):
    answer = client.post(f"{URL}/{session_id}/position-check", json={"operator": "A. Therapist"} | body)
    assert (answer.status_code, answer.json()["field"]) == (422, field)
    assert running.commands == []


@pytest.mark.parametrize(
    ("state", "status", "text"),
    [
        (PositionState(tolerance=TOLERANCE), "first_fraction", "becomes the plan's position"),
        (PositionState(is_required=True, tolerance=TOLERANCE), "no_reference", "set the reference"),
        (UNSIGNED, "unsigned", "longitudinal +2.4 mm), not signed"),
        (replace(UNSIGNED, lapse="the patient moved"), "lapsed", "the patient moved"),
        (replace(UNSIGNED, signature=Signature("ann", 1, "lasers")), "signed", "signed by ann"),
    ],
)
def test_session_and_stream_show_it(client, session_id, running, state, status, text):
    running.frame()
    running.latest = replace(running.latest, position=state)
    shown = client.get(f"{URL}/{session_id}").json()["position_check"]
    assert shown["status"] == status
    assert text in shown["text"]
    assert shown["is_within"] is False
    assert shown["signed_by"] == ("ann" if status == "signed" else None)
    assert client.app.state.services.runner.newest().message.position_check.model_dump() == shown


def test_a_degree_of_freedom_that_is_not_determined_has_no_number(client, session_id, running):
    running.frame()
    running.latest = replace(running.latest, position=UNSIGNED)
    lateral, longitudinal, *_ = client.get(f"{URL}/{session_id}").json()["position_check"]["degrees"]
    assert lateral == {
        "name": "lateral", "unit": "mm", "value": None, "uncertainty": 1.2, "tolerance": 2.0, "is_within": False
    }  # fmt: skip
    assert (longitudinal["value"], longitudinal["is_within"]) == (2.4, False)
