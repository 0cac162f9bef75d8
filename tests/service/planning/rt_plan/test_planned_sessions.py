"""Sessions from plans: what the plan says is the plan's, and who goes against it is a person who says why."""

from datetime import UTC, datetime, timedelta

import pytest

from service.core.permissions import KEY_PERMISSIONS
from service.core.schemas.windows import Window
from service.planning.rt_plan.gating import mismatch
from service.planning.rt_plan.reading import read_plan
from tests.support.planning.api_calls import AMPLITUDE, BREATH_HOLD, URL, kept, prepare, send
from tests.support.planning.dicom_plans import beam, group, motion, photon_plan, setup, written
from tests.support.service.api_calls import act, audit_rows, make_session_body

pytestmark = pytest.mark.slow

SESSIONS = "/api/v1/sessions"
BOTH = {**BREATH_HOLD, "further": [{"kind": "amplitude", "lower_mm": -5.0, "upper_mm": 20.0}]}
PHASE = {"kind": "phase", "from_percent": 40.0, "to_percent": 60.0}


def of(technique):
    """Make a plan's changes so that it prescribes this."""
    return {"PatientSetupSequence": [setup(1, *([motion(technique)] if technique else []))]}


def end(client, session_id):
    assert act(client, session_id, "stop").status_code == 200


@pytest.mark.both_databases
def test_patient_plan_and_fraction_are_the_plans(client, plan, asked):
    answer = prepare(client, plan, asked)
    session = answer.json()
    assert answer.status_code == 201
    assert (session["patient_reference"], session["plan_id"], session["rt_plan_id"]) == (
        "P-0001",
        "LUNG_DIBH",
        plan["id"],
    )
    assert (session["fraction_id"], session["fraction_number"], session["status"]) == ("FX-3", 3, "created")
    assert session["warnings"] == []
    read = client.get(f"{SESSIONS}/{session['id']}").json()
    assert (read["rt_plan_id"], read["operator"]) == (plan["id"], "A. Therapist")


def test_a_session_without_a_plan_states_it(client, calibration_id):
    session = client.post(SESSIONS, json=make_session_body(calibration_id)).json()
    assert session["rt_plan_id"] is None
    assert client.post(SESSIONS, json=make_session_body(calibration_id) | {"rt_plan_id": "0" * 32}).status_code == 422


def test_values_of_the_plan_cannot_be_overridden(client, plan, asked):
    for name in ("patient_reference", "plan_id", "fraction_id", "rt_plan_id"):
        assert prepare(client, plan, asked | {name: "other"}).status_code == 422


def test_a_key_gives_the_same_session_and_refuses_another_plan(client, plan, asked):
    headers = {"Idempotency-Key": "k1"}
    first = prepare(client, plan, asked, **headers)
    again = prepare(client, plan, asked, **headers)
    assert (again.json(), again.headers["Idempotency-Replayed"]) == (first.json(), "true")
    other = kept(client, SOPInstanceUID="1.2.3")
    assert prepare(client, other, asked, **headers).json()["code"] == "idempotency_key_reused"


WINDOWS = [
    ("BREATH_HOLD", BREATH_HOLD, True),
    ("BREATH_HOLD", AMPLITUDE, False),
    ("BREATH_HOLD", PHASE, False),
    ("BREATH_HOLD", BOTH, True),
    ("BREATH_HOLD", {**BOTH, "join": "or"}, False),
    ("GATING", AMPLITUDE, True),
    ("GATING", PHASE, True),
    ("GATING", BREATH_HOLD, False),
    ("GATING", {**BOTH, "join": "or"}, False),
    ("NONE", AMPLITUDE, True),
    ("NONE", BREATH_HOLD, False),
    (None, AMPLITUDE, True),
    (None, BREATH_HOLD, True),
    ("UNKNOWN", BREATH_HOLD, True),
    ("TRACKING", AMPLITUDE, False),
    ("RETROSPECTIVE", BREATH_HOLD, False),
]


@pytest.mark.parametrize(("technique", "window", "is_taken"), WINDOWS)
def test_the_window_is_of_the_technique_that_is_prescribed(technique, window, is_taken):
    plan = read_plan(written(photon_plan(**of(technique))))
    assert (mismatch(plan.gating, Window.model_validate(window)) is None) == is_taken


def test_a_window_of_another_technique_is_refused_and_audited(client, plan, asked):
    answer = prepare(client, plan, asked | {"window": AMPLITUDE})
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["field"]) == (409, "plan_gating", "window.kind")
    assert client.get(SESSIONS).json()["items"] == []
    row = audit_rows(client, "session.create")[-1]
    assert (row["outcome"], row["detail"]["code"]) == ("refused", "plan_gating")


def test_a_person_may_override_with_a_reason_that_is_kept_and_reported(client, plan, asked):
    reason = "patient cannot hold; physicist A agreed"
    answer = prepare(client, plan, asked | {"window": AMPLITUDE, "overrides_plan_gating": reason})
    assert answer.status_code == 201
    assert any("overridden" in warning for warning in answer.json()["warnings"])
    row = audit_rows(client, "session.create")[-1]
    assert (row["actor"], row["outcome"]) == ("A. Therapist", "done")
    assert row["detail"]["overrides_plan_gating"] == reason
    assert (row["detail"]["rt_plan_id"], row["detail"]["plan_gating"]) == (plan["id"], "breath_hold")


def test_an_override_needs_a_reason(client, plan, asked):
    for name in ("overrides_plan_gating", "repeats_fraction", "overrides_contradiction"):
        for reason in ("", "   ", "x" * 81, 1):
            assert prepare(client, plan, asked | {name: reason}).status_code == 422


def test_a_machine_cannot_override_a_plan_for_any_person(client, plan, asked):
    until = datetime.now(UTC) + timedelta(days=1)
    key = client.desk.keys.create("planning", KEY_PERMISSIONS, until, by="A. Therapist")
    headers = {"Authorization": f"Bearer {key.secret}"}
    client.speaks_as = None
    for name in ("overrides_plan_gating", "repeats_fraction", "overrides_contradiction"):
        body = asked | {"window": AMPLITUDE, name: "because"}
        answer = client.post(f"{URL}/{plan['id']}/sessions", json=body, headers=headers)
        assert (answer.status_code, answer.json()["code"]) == (403, "override_needs_person")
        assert answer.json()["field"] == name
    assert client.post(f"{URL}/{plan['id']}/sessions", json=asked, headers=headers).status_code == 201


def test_no_fraction_is_treated_that_is_not_planned(client, plan, asked):
    for number in (31, 0, 201, "3"):
        answer = prepare(client, plan, asked | {"fraction_number": number})
        assert (answer.status_code, answer.json()["field"]) == (422, "fraction_number")
    assert prepare(client, plan, asked | {"fraction_number": 30}).status_code == 201


def test_a_plan_that_does_not_say_how_many_fractions_is_reported_and_bounded_all_the_same(client, asked):
    plan = kept(client, FractionGroupSequence=[group(fractions=None)])
    answer = prepare(client, plan, asked | {"fraction_number": 200})
    assert answer.status_code == 201
    assert any("number of planned fractions" in warning for warning in answer.json()["warnings"])


def test_with_several_fraction_groups_one_is_named_and_its_beams_decide(client, asked):
    plan = kept(
        client,
        BeamSequence=[beam(1, setup_number=1), beam(2, setup_number=2)],
        PatientSetupSequence=[setup(1, motion("BREATH_HOLD")), setup(2, motion("GATING"))],
        FractionGroupSequence=[group(1, beams=(1,), fractions=20), group(2, beams=(2,), fractions=5)],
    )
    assert plan["gating"] == "mixed"
    for wrong in (None, 3):
        problem = prepare(client, plan, asked | {"fraction_group": wrong}).json()
        assert (problem["field"], problem["bound"]) == ("fraction_group", "one of the plan's groups: 1, 2")
    assert prepare(client, plan, asked | {"fraction_group": 2, "fraction_number": 6}).status_code == 422
    assert prepare(client, plan, asked | {"fraction_group": 2}).json()["code"] == "plan_gating"
    answer = prepare(client, plan, asked | {"fraction_group": 1, "fraction_number": 6})
    assert (answer.status_code, answer.json()["fraction_id"]) == (201, "FG-1-FX-6")


@pytest.mark.both_databases
def test_a_fraction_that_was_begun_is_repeated_by_a_person_with_a_reason_only(client, plan, asked):
    first = prepare(client, plan, asked).json()
    assert act(client, first["id"], "start").status_code == 200
    end(client, first["id"])
    answer = prepare(client, plan, asked)
    assert (answer.status_code, answer.json()["code"]) == (409, "fraction_done")
    assert first["id"] in answer.json()["detail"]
    assert prepare(client, plan, asked | {"repeats_fraction": "stopped after beam 1"}).status_code == 201
    assert audit_rows(client, "session.create")[-1]["detail"]["repeats_fraction"] == "stopped after beam 1"


@pytest.mark.both_databases
def test_the_list_of_plans_states_the_fraction_that_comes_next_and_the_newest_session(client, plan, asked):
    def listed():
        return client.get("/api/v1/plans").json()["items"][0]

    assert (listed()["next_fraction"], listed()["fractions_planned"], listed()["last_session"]) == (1, 30, None)
    never = prepare(client, plan, asked | {"fraction_number": 4}).json()
    end(client, never["id"])
    assert (listed()["next_fraction"], listed()["last_session"]) == (1, None)
    begun = prepare(client, plan, asked | {"fraction_number": 2}).json()
    assert act(client, begun["id"], "start").status_code == 200
    assert listed()["last_session"]["status"] == "running"
    end(client, begun["id"])
    last = listed()["last_session"]
    assert (last["id"], last["status"], last["fraction_number"]) == (begun["id"], "stopped", 2)
    assert listed()["next_fraction"] == 3


@pytest.mark.both_databases
def test_plans_and_sessions_are_searched_as_text_in_any_case_and_not_as_a_pattern(client, plan, asked):
    prepare(client, plan, asked)
    for path in ("plans", "sessions"):
        for search, count in (("p-0001", 1), ("UNG_d", 1), ("%", 0), ("P_0001", 0), ("P-0002", 0)):
            found = client.get(f"/api/v1/{path}", params={"search": search}).json()["items"]
            assert len(found) == count, (path, search)
    assert len(client.get("/api/v1/sessions", params={"search": "fx-3"}).json()["items"]) == 1
    assert client.get("/api/v1/sessions", params={"search": ""}).status_code == 422


def test_a_fraction_that_was_never_begun_or_is_another_one_is_free(client, plan, asked):
    end(client, prepare(client, plan, asked).json()["id"])
    assert prepare(client, plan, asked).status_code == 201
    end(client, client.get(SESSIONS).json()["items"][0]["id"])
    assert prepare(client, plan, asked | {"fraction_number": 4}).status_code == 201


def test_a_rejected_plan_gives_no_session_to_any_role(client, asked):
    plan = kept(client, ApprovalStatus="REJECTED")
    answer = prepare(client, plan, asked | {"overrides_plan_gating": "because"})
    assert (answer.status_code, answer.json()["code"]) == (409, "plan_rejected")


def say_otherwise(client, **changes):
    """Send a file of the same UID that says something else."""
    answer = send(client, written(photon_plan(**changes)))
    assert (answer.status_code, answer.json()["code"]) == (409, "plan_conflict")


@pytest.mark.both_databases
def test_a_plan_that_was_rejected_after_its_import_gives_no_session_to_any_role(client, plan, asked):
    say_otherwise(client, ApprovalStatus="REJECTED")
    say_otherwise(client, RTPlanName="another")
    for reason in ({}, {"overrides_contradiction": "because"}):
        answer = prepare(client, plan, asked | reason)
        assert (answer.status_code, answer.json()["code"]) == (409, "plan_rejected")


@pytest.mark.both_databases
def test_a_plan_that_a_later_file_contradicts_states_it_and_needs_a_person_with_a_reason(client, plan, asked):
    etag = client.get(f"{URL}/{plan['id']}").headers["ETag"]
    for _ in range(2):
        say_otherwise(client, FractionGroupSequence=[group(fractions=29)], ApprovalStatus="UNAPPROVED")
    read = client.get(f"{URL}/{plan['id']}", headers={"If-None-Match": etag})
    reported = read.json()["contradicted"]
    assert (read.status_code, reported["approval"], reported["imported_by"]) == (200, "UNAPPROVED", "A. Therapist")
    assert {"approval", "fraction_groups"} <= set(reported["differing"])
    (row,) = audit_rows(client, "plan.contradicted")
    assert row["detail"]["rt_plan_id"] == plan["id"]
    answer = prepare(client, plan, asked)
    assert (answer.status_code, answer.json()["code"]) == (409, "plan_contradicted")
    answer = prepare(client, plan, asked | {"overrides_contradiction": "physicist A compared both"})
    assert answer.status_code == 201
    assert any("later file" in warning for warning in answer.json()["warnings"])
    assert audit_rows(client, "session.create")[-1]["detail"]["overrides_contradiction"] == "physicist A compared both"


def test_an_approval_that_comes_later_is_no_contradiction(client, asked):
    plan = kept(client, ApprovalStatus="UNAPPROVED")
    say_otherwise(client)
    assert client.get(f"{URL}/{plan['id']}").json()["contradicted"] is None
    answer = prepare(client, plan, asked)
    assert answer.status_code == 201
    assert any("UNAPPROVED" in warning for warning in answer.json()["warnings"])


def test_what_the_plan_does_not_settle_is_reported_with_the_session(client, asked):
    plan = kept(client, **of(None), ApprovalStatus="UNAPPROVED", PlanIntent="RESEARCH")
    reported = " / ".join(prepare(client, plan, asked).json()["warnings"])
    for word in ("prescribes no gating", "UNAPPROVED", "RESEARCH"):
        assert word in reported


def test_one_session_at_a_time_from_plans_too(client, plan, asked):
    assert prepare(client, plan, asked).status_code == 201
    assert prepare(client, plan, asked).json()["code"] == "session_active"


def test_a_plan_that_is_not_there_gives_no_session_and_a_row(client, asked):
    answer = prepare(client, {"id": "0" * 32}, asked)
    assert (answer.status_code, answer.json()["field"]) == (404, "plan_id")
    assert audit_rows(client, "session.create")[-1]["detail"]["rt_plan_id"] == "0" * 32
