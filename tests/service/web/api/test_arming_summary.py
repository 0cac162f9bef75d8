"""The summary before arming: what would be gated, and what is missing; its ETag ties the arming to what was seen."""

from dataclasses import replace

import pytest

from engine.capture.source import SourceDescription
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from engine.gating.supervision.checks import Check, CheckState
from service.core.errors import QaOverdueError
from tests.support.documents.sentences import templates
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.clinical_site import clinical_settings
from tests.support.service.fake_engine import make_model

WINDOW = {"signal": "whole", "lower_mm": -2.0, "upper_mm": 1.5, "dwell_ms": 250.0}


def summary(client, session_id):
    return client.get(f"/api/v1/sessions/{session_id}/arming")


def items(client, session_id):
    return {one["code"]: (one["state"], one["text"]) for one in summary(client, session_id).json()["items"]}


def set_window(client, session_id, window=None, **headers):
    body = {"operator": "B. Physicist", "window": WINDOW if window is None else window}
    return client.post(f"/api/v1/sessions/{session_id}/window", json=body, headers=headers)


@pytest.fixture
def measuring(running):
    """A session that measures, with a model and a reference."""
    running.model, running.has_reference = make_model(1), True
    running.frame()
    return running


def test_every_part_is_named_once_and_in_order(client, session_id, measuring):
    found = [one["code"] for one in summary(client, session_id).json()["items"]]
    assert found == [
        "patient",
        "plan",
        "camera",
        "head_direction",
        "view",
        "model",
        "reference",
        "window",
        "position",
        "checks",
        "site",
        "gate",
    ]


def test_every_line_but_names_is_a_sentence_that_can_be_translated(client, session_id, measuring):
    found = summary(client, session_id).json()
    parts = {one["text"]: one["template"] for one in found["sentences"]}
    known = templates() | {"{part0}, {part1}", "{part0}; {part1}", "{part0} {part1}", "{part0}: {part1}"}
    assert [one["text"] for one in found["items"][1:] if parts.get(one["text"], one["text"]) not in known] == []
    assert set(parts.values()) <= known
    assert len(parts) >= 5


def test_a_check_that_cannot_work_is_looked_at(client, session_id, measuring):
    assert items(client, session_id)["checks"] == ("attention", "not known before the reference is set")
    on = [CheckState(check, is_on=True, since_us=0, was_on=True) for check in Check]
    measuring.checks = (on[0], on[1], on[2]._replace(is_on=False, was_on=False))
    measuring.frame()
    state, text = items(client, session_id)["checks"]
    assert state == "attention"
    assert "camera: too little of couch and floor is seen" in text
    measuring.checks = tuple(on)
    measuring.frame()
    measuring.latest = replace(measuring.latest, is_clock_checked=True)
    state, text = items(client, session_id)["checks"]
    assert state == "ok"
    assert "none surely sees a skin-coloured cover" in text  # what physics forbids is stated even then


def test_patient_plan_and_fraction_are_those_of_the_session(client, session_id, measuring):
    session, found = client.get(f"/api/v1/sessions/{session_id}").json(), items(client, session_id)
    assert found["patient"] == ("ok", session["patient_reference"])
    assert session["plan_id"] in found["plan"][1]
    assert session["fraction_id"] in found["plan"][1]


@pytest.mark.parametrize(
    ("change", "code", "word"),
    [
        ({"model": None}, "model", "no motion model"),
        ({"has_reference": False}, "reference", "not set"),
    ],
)
def test_what_is_missing_is_named(client, session_id, measuring, change, code, word):
    for name, value in change.items():
        setattr(measuring, name, value)
    measuring.frame()
    state, text = items(client, session_id)[code]
    assert (state, word in text) == ("missing", True)
    assert summary(client, session_id).json()["is_ready"] is False


def test_a_latched_fault_and_an_armed_gate_are_missing_and_a_hold_is_to_be_looked_at(client, session_id, measuring):
    measuring.latest = replace(measuring.latest, is_armed=True, armed_by="A. Therapist")
    assert items(client, session_id)["gate"] == ("missing", "armed already, by A. Therapist")
    record = replace(measuring.latest.record, gate_state=GateState.FAULT, hold_reason=HoldReason.WATCHDOG)
    measuring.latest = replace(measuring.latest, is_armed=False, record=record)
    assert items(client, session_id)["gate"][0] == "missing"
    act(client, session_id, "hold", operator="C. Nurse")
    record = replace(measuring.latest.record, gate_state=GateState.DISARMED, hold_reason=HoldReason.DISARMED)
    measuring.latest = replace(measuring.latest, record=record)
    assert items(client, session_id)["gate"] == ("attention", "held by C. Nurse: armed, it stays held")


def test_a_site_rule_that_forbids_arming_is_missing(client, session_id, measuring):
    def refuse(_source):
        raise QaOverdueError("the daily QA is overdue", field="qa", bound="passed within 24 h")

    services = client.app.state.services
    client.app.state.services = replace(services, arming=replace(services.arming, refuse_arming=refuse))
    state, text = items(client, session_id)["site"]
    assert (state, "the daily QA is overdue" in text) == ("missing", True)


@pytest.mark.parametrize("is_live", [False, True])
def test_a_tick_stands_only_where_something_was_compared(client, session_id, measuring, monkeypatch, is_live):
    source = SourceDescription(
        kind="openni", name="camera", depth_size=(640, 480), color_size=(640, 480), fps=30.0, is_live=is_live
    )
    own = type(measuring).status
    monkeypatch.setattr(type(measuring), "status", property(lambda self: replace(own.fget(self), source=source)))
    found = items(client, session_id)
    assert found["camera"][0] == "attention"
    assert ("which camera made it" in found["camera"][1]) is not is_live
    assert found["site"] == ("attention", "no QA is required here")


def test_a_session_that_does_not_run_is_not_ready(client, session_id):
    found = items(client, session_id)
    assert found["gate"][0] == "missing"
    assert found["camera"] == ("missing", "not open")


def test_arming_with_the_summary_s_tag_is_refused_where_the_window_was_set_since(client, session_id, measuring):
    tag = summary(client, session_id).headers["ETag"]
    assert set_window(client, session_id).status_code == 200
    body = {"operator": "B. Physicist"}
    refused = client.post(f"/api/v1/sessions/{session_id}/arm", json=body, headers={"If-Match": tag})
    assert refused.status_code == 412
    tag = summary(client, session_id).headers["ETag"]
    armed = client.post(f"/api/v1/sessions/{session_id}/arm", json=body, headers={"If-Match": tag})
    assert armed.status_code == 200


def arm(client, session_id, headers=None, **body):
    return client.post(f"/api/v1/sessions/{session_id}/arm", json={"operator": "B. Physicist"} | body, headers=headers)


def test_an_arming_carries_the_state_that_was_looked_at_to_the_engine(client, session_id, measuring):
    state = summary(client, session_id).json()["state"]
    assert state == measuring.arming_state
    assert arm(client, session_id, state=state).status_code == 200
    assert measuring.commands[-1].seen == state
    assert audit_rows(client, "session.arm")[-1]["detail"]["state"] == state


@pytest.mark.parametrize(("tag", "carried"), [(None, None), ("*", None), ("the summary's", "5e" * 16)])
def test_an_arming_with_the_summary_s_tag_alone_carries_the_state_of_then(client, session_id, measuring, tag, carried):
    etag = summary(client, session_id).headers["ETag"]
    headers = {} if tag is None else {"If-Match": tag if tag == "*" else etag}
    assert arm(client, session_id, headers).status_code == 200
    assert measuring.commands[-1].seen == carried


def test_the_state_is_read_before_the_tag_is_compared(client, session_id, measuring, monkeypatch):
    """Or a window set between the two would be taken for the one that was looked at."""
    etag, revisions = summary(client, session_id).headers["ETag"], client.app.state.services.revisions
    compared = type(revisions).etag

    def changed_meanwhile(self, session_id):
        found = compared(self, session_id)
        measuring.arming_state = "c0" * 16
        return found

    monkeypatch.setattr(type(revisions), "etag", changed_meanwhile)
    assert arm(client, session_id, {"If-Match": etag}).status_code == 200
    assert measuring.commands[-1].seen == "5e" * 16


def test_in_clinical_mode_an_arming_names_what_was_looked_at(client, session_id, measuring, monkeypatch):
    commands = client.app.state.services.runner.commands
    monkeypatch.setattr(commands, "_settings", clinical_settings())
    before = len(measuring.commands)
    refused = arm(client, session_id)
    problem = refused.json()
    assert (refused.status_code, problem["field"], problem["bound"]) == (422, "state", "the state of GET .../arming")
    assert len(measuring.commands) == before
    assert arm(client, session_id, state=measuring.arming_state).status_code == 200


def test_a_window_that_was_set_is_the_session_s_and_the_audit_has_both(client, session_id, measuring):
    answer = set_window(client, session_id)
    assert answer.status_code == 200
    stored = client.get(f"/api/v1/sessions/{session_id}").json()["window"]
    assert (stored["lower_mm"], stored["upper_mm"], stored["dwell_ms"]) == (-2.0, 1.5, 250.0)
    asked, done = audit_rows(client, "session.window")
    assert (asked["outcome"], done["outcome"], done["actor"]) == ("requested", "done", "B. Physicist")
    assert done["detail"]["window_before"][0]["upper"] == 3.0
    assert done["detail"]["window_after"][0]["upper"] == 1.5
    command = measuring.commands[-1]
    assert (command.dwell_ms, command.window.upper, command.operator) == (250.0, 1.5, "B. Physicist")


def test_the_site_s_bounds_hold_for_it_and_a_refused_one_is_audited(client, session_id, measuring):
    answer = set_window(client, session_id, WINDOW | {"dwell_ms": 0.0, "upper_mm": 101.0})
    assert answer.status_code == 422
    before = client.get(f"/api/v1/sessions/{session_id}").json()["window"]
    measuring.refuse_with = None
    wide = set_window(client, session_id, WINDOW | {"kind": "unknown"})
    assert (wide.status_code, wide.json()["field"]) == (422, "window.kind")
    assert client.get(f"/api/v1/sessions/{session_id}").json()["window"] == before


@pytest.mark.parametrize(
    ("site", "field"),
    [({"min_dwell_ms": 300.0}, "window.dwell_ms"), ({"window_upper_mm": 1.0}, "window.upper_mm")],
)
def test_a_site_that_is_narrower_refuses_it_by_field(client, session_id, measuring, settings, site, field):
    commands = client.app.state.services.runner.commands
    commands._window_setting = replace(commands._window_setting, settings=settings.model_copy(update=site))
    answer = set_window(client, session_id)
    assert (answer.status_code, answer.json()["field"]) == (422, field)
    assert audit_rows(client, "session.window")[-1]["outcome"] == "refused"
    assert measuring.commands == []


def test_a_refusal_of_the_engine_leaves_the_stored_window(client, session_id, measuring):
    before = client.get(f"/api/v1/sessions/{session_id}").json()["window"]
    measuring.refuse_with = CommandRefusedError("the gate is armed: disarm it before its window is set")
    assert set_window(client, session_id).status_code == 409
    assert client.get(f"/api/v1/sessions/{session_id}").json()["window"] == before
    assert audit_rows(client, "session.window")[-1]["outcome"] == "refused"


def test_of_a_session_that_does_not_run_no_window_is_set(client, session_id):
    assert set_window(client, session_id).status_code == 409


def test_who_armed_is_shown_with_the_time(client, session_id, measuring):
    act(client, session_id, "arm", operator="A. Therapist")
    measuring.frame()
    gate = client.get(f"/api/v1/sessions/{session_id}").json()["gate"]
    at = audit_rows(client, "session.arm")[-1]["at"]
    assert gate["armed_by"] == "A. Therapist"
    assert gate["armed_at"][:19] == at[:19]
    act(client, session_id, "disarm")
    measuring.frame()
    assert client.get(f"/api/v1/sessions/{session_id}").json()["gate"]["armed_at"] is None
