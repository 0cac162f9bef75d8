"""The first reference of a fraction outlives its session, and only a person who may arm goes far from it."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

from engine.core.breath import WHOLE, Breath
from engine.core.commands import CorrectBaseline, SetReference
from engine.core.errors import ReferenceDistanceError
from engine.core.learning_status import LearningEvent, LearningEventKind
from engine.core.reference import NODES, FirstReference, ReferenceDistance, SignalLevel
from service.core.permissions import KEY_PERMISSIONS
from service.sessions.views.position import live_reference
from tests.support.service.api_calls import act, audit_rows, make_session_body
from tests.support.waiting import eventually

URL = "/api/v1/sessions"
FIRST = FirstReference(
    calibration_sha256="c" * 64,
    layout_sha256="d" * 64,
    regions_mm=np.full(115, 850.25),
    surface_mm=np.full((NODES, 3), 850.5),
    plane_mm=850.0,
    volume_l=0.5,
)
SET = LearningEvent(
    kind=LearningEventKind.REFERENCE_SET, detail="the first", timestamp_us=7, figures={"distance_mm": 0.0}, first=FIRST
)
LOWERED = ReferenceDistance(
    moved_mm=2.5,
    shift_mm=0.4,
    height_mm=-2.44,
    turn_deg=0.2,
    tilt_deg=0.3,
    shape_mm=0.1,
    levels=(SignalLevel(WHOLE, -2.5),),
    correction=-0.3,
)
TOO_FAR = ReferenceDistanceError("by", "3.00 mm from the fraction's first", "within 2 mm of it", "give a reason")


def begun(client, engine, calibration_id, **changes):
    """Start a session; return its id and what its engine was given."""
    session_id = client.post(URL, json=make_session_body(calibration_id) | changes).json()["id"]
    assert act(client, session_id, "start").status_code == 200
    return session_id, engine.running.plan.first_reference


@pytest.fixture
def over(client, engine, calibration_id):
    """A session that is over, in which the fraction's first reference was set."""
    session_id, before = begun(client, engine, calibration_id)
    assert before is None
    engine.running.notices.put_nowait(SET)
    eventually(lambda: audit_rows(client, "model.reference_set"))
    act(client, session_id, "stop")
    return session_id


@pytest.mark.both_databases
def test_a_later_session_of_the_fraction_continues_from_its_first_reference(client, engine, calibration_id, over):
    (row,) = audit_rows(client, "model.reference_set")
    assert row["detail"] == {"distance_mm": 0.0, "detail": "the first", "timestamp_us": 7}
    session_id, first = begun(client, engine, calibration_id)
    assert first.calibration_sha256 == FIRST.calibration_sha256
    assert np.array_equal(first.surface_mm, FIRST.surface_mm)
    assert np.array_equal(first.regions_mm, FIRST.regions_mm)
    started = audit_rows(client, "session.start")[-1]
    assert (started["session_id"], started["detail"]["first_reference_of_session"]) == (session_id, over)
    engine.running.notices.put_nowait(replace(SET, first=replace(FIRST, plane_mm=1.0)))
    eventually(lambda: len(audit_rows(client, "model.reference_set")) == 2)
    act(client, session_id, "stop")
    assert begun(client, engine, calibration_id)[1].plane_mm == FIRST.plane_mm  # the first stays the first


@pytest.mark.parametrize(
    ("other", "continues"),
    [
        ({"patient_reference": "P-0002"}, False),
        ({"plan_id": "PLAN-2"}, False),
        ({"fraction_id": "FX-4"}, False),
        ({"fraction_number": 4}, False),
        ({"fraction_number": None}, True),
    ],
)
def test_a_fraction_is_patient_plan_name_and_number(client, engine, calibration_id, over, other, continues):
    assert over
    assert (begun(client, engine, calibration_id, **other)[1] is not None) == continues


def test_another_fraction_between_changes_nothing(client, engine, calibration_id, over):
    assert over
    session_id, _ = begun(client, engine, calibration_id, fraction_id="FX-4")
    act(client, session_id, "stop")
    assert begun(client, engine, calibration_id)[1] is not None


def test_a_person_may_go_beyond_and_the_reason_is_audited(client, session_id, running):
    body = {"operator": "A. Therapist", "at": "now", "reason": "re-planned"}
    assert client.post(f"{URL}/{session_id}/reference", json=body).status_code == 200
    assert running.commands[-1].may_exceed
    running.breaths = (Breath(drift=1.6),)
    running.frame()
    body = {"operator": "A. Therapist", "by_mm": 1.5, "drift_mm": 1.6, "reason": "relaxed"}
    assert client.post(f"{URL}/{session_id}/baseline-correction", json=body).status_code == 200
    assert running.commands[-1] == CorrectBaseline(operator="A. Therapist", by=1.5, reason="relaxed", may_exceed=True)
    assert audit_rows(client, "session.baseline_correction")[-1]["detail"]["reason"] == "relaxed"


def test_no_key_goes_beyond_even_with_a_reason(client, session_id, running):
    running.breaths = (Breath(drift=1.6),)
    running.frame()
    client.speaks_as = None
    body = {"operator": "A. Therapist", "by_mm": 1.5, "drift_mm": 1.6, "reason": "relaxed"}
    desk = client.desk
    made = desk.keys.create("planning", KEY_PERMISSIONS, desk.store.now() + timedelta(days=1), by="test")
    headers = {"Authorization": f"Bearer {made.secret}"}
    answer = client.post(f"{URL}/{session_id}/baseline-correction", json=body, headers=headers)
    assert answer.status_code == 200, answer.text
    assert isinstance(running.commands[-1], CorrectBaseline)
    assert not running.commands[-1].may_exceed
    answer = client.post(f"{URL}/{session_id}/reference", json={"at": "now", "reason": "relaxed"}, headers=headers)
    assert answer.status_code == 403
    assert not any(isinstance(command, SetReference) for command in running.commands)


WINDOW = {"signal": "whole", "lower_mm": -2.0, "upper_mm": 1.5, "dwell_ms": 250.0}


@pytest.mark.parametrize("is_key", [False, True])
def test_a_window_beyond_the_budget_is_a_person_s_with_a_reason_which_the_audit_keeps(
    client, session_id, running, is_key
):
    running.frame()
    headers = {}
    if is_key:
        client.speaks_as, desk = None, client.desk
        made = desk.keys.create("planning", KEY_PERMISSIONS, desk.store.now() + timedelta(days=1), by="test")
        headers = {"Authorization": f"Bearer {made.secret}"}
    body = {"operator": "A. Therapist", "window": WINDOW, "reason": " adapted "}
    assert client.post(f"{URL}/{session_id}/window", json=body, headers=headers).status_code == 200
    assert (running.commands[-1].reason, running.commands[-1].may_exceed) == ("adapted", not is_key)
    if not is_key:
        assert audit_rows(client, "session.window")[-1]["detail"]["reason"] == "adapted"


@pytest.mark.parametrize(
    ("path", "body", "field"),
    [
        ("window", {"window": WINDOW}, "window"),
        ("reference", {"at": "now"}, "reference"),
        ("baseline-correction", {"by_mm": 1.5, "drift_mm": 1.6}, "by_mm"),
    ],
)
def test_a_refusal_names_field_distance_and_budget(client, session_id, running, path, body, field):
    running.breaths = (Breath(drift=1.6),)
    running.frame()
    running.refuse_with = TOO_FAR if field == "by_mm" else ReferenceDistanceError(field, *TOO_FAR_PARTS)
    answer = client.post(f"{URL}/{session_id}/{path}", json={"operator": "A. Therapist", **body})
    assert answer.status_code == 409
    problem = answer.json()
    assert (problem["code"], problem["field"]) == ("reference_distance", field)
    assert (problem["value"], problem["bound"]) == ("3.00 mm from the fraction's first", "within 2 mm of it")
    refused = audit_rows(client)[-1]
    assert (refused["outcome"], refused["detail"]["value"]) == ("refused", "3.00 mm from the fraction's first")


TOO_FAR_PARTS = (TOO_FAR.value, TOO_FAR.bound, TOO_FAR.advice)


def test_session_and_stream_show_the_distance(client, session_id, running):
    assert client.get(f"{URL}/{session_id}").json()["reference"] is None
    running.frame()
    assert client.get(f"{URL}/{session_id}").json()["reference"] is None
    running.latest = replace(running.latest, reference_distance=replace(LOWERED, uncertainty_mm=0.0912))
    shown = client.get(f"{URL}/{session_id}").json()["reference"]
    assert shown == {
        "text": "reference 2.8 mm from the fraction's first, uncertain by 0.1 mm",
        "distance_mm": 2.8,
        "budget_mm": 2.0,
        "is_beyond": True,
        "moved_mm": 2.5,
        "shift_mm": 0.4,
        "height_mm": -2.44,
        "turn_deg": 0.2,
        "tilt_deg": 0.3,
        "shape_mm": 0.1,
        "uncertainty_mm": 0.091,
        "level": -2.8,
        "correction": -0.3,
        "unit": "mm",
        "unknown": "",
    }
    assert client.app.state.services.runner.newest().message.reference.model_dump() == shown


def test_a_distance_that_is_not_known_is_shown_as_that(running):
    running.frame()
    shown = live_reference(replace(running.latest, reference_distance=ReferenceDistance(unknown="it was away")))
    assert (shown.distance_mm, shown.is_beyond, shown.unknown) == (None, True, "it was away")
    assert shown.text == "reference at an unknown distance from the fraction's first"
    assert (shown.shift_mm, shown.level) == (None, None)
