"""The reference over the API: a logged-in person confirms what is proposed; no key may."""

import pytest

from engine.core.breath import WHOLE, SignalChoice
from engine.core.commands import SetReference
from engine.core.learning_status import LearningStatus
from engine.core.position_check import PositionTolerance
from engine.core.reference import ReferenceDistance, ReferenceMoment, ReferenceProposal, SignalLevel
from service.core.permissions import KEY_PERMISSIONS, ROLE_PERMISSIONS, Permission, Role
from service.sessions.views.position import proposal_views
from tests.support.service.api_calls import audit_rows
from tests.support.service.clinical_site import clinical_settings

URL = "/api/v1/sessions"
BODY = {"operator": "A. Therapist"}
TOLERANCE = PositionTolerance(shift_mm=2.0, turn_deg=1.0, shape_mm=2.0)


def test_without_a_moment_it_is_the_end_of_exhale(client, session_id, running):
    assert client.post(f"{URL}/{session_id}/reference", json=BODY).status_code == 200
    assert running.commands == [
        SetReference(operator="A. Therapist", moment=ReferenceMoment.END_EXHALE, may_exceed=True)
    ]


def test_moment_level_and_reason_reach_the_engine_and_the_audit(client, session_id, running):
    shown = {"at": "now", "level_seen": -1.25, "move_seen_mm": 2.04, "reason": "mid-ventilation plan"}
    assert client.post(f"{URL}/{session_id}/reference", json=BODY | shown).status_code == 200
    (command,) = running.commands
    assert (command.moment, command.level_seen, command.move_seen_mm) == (ReferenceMoment.NOW, -1.25, 2.04)
    assert command.reason == "mid-ventilation plan"
    for row in audit_rows(client, "session.reference"):
        assert row["actor"] == "A. Therapist"
        assert row["detail"] == shown | {"setup_confirmed": False, "proposed": None}


def test_in_clinical_mode_a_person_confirms_stickers_and_chest_once_a_session(client, session_id, running, monkeypatch):
    monkeypatch.setattr(client.app.state.services.runner.commands, "_settings", clinical_settings())
    refused = client.post(f"{URL}/{session_id}/reference", json=BODY)
    assert (refused.status_code, refused.json()["field"]) == (422, "setup_confirmed")
    assert running.commands == []
    assert client.post(f"{URL}/{session_id}/reference", json=BODY | {"setup_confirmed": True}).status_code == 200
    row = audit_rows(client, "session.reference")[-1]
    assert (row["actor"], row["outcome"], row["detail"]["setup_confirmed"]) == ("A. Therapist", "done", True)
    assert client.post(f"{URL}/{session_id}/reference", json=BODY).status_code == 200


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"at": "exhale"}, "at"),
        ({"level_seen": 1e4}, "level_seen"),
        ({"level_seen": "low"}, "level_seen"),
        ({"move_seen_mm": -0.1}, "move_seen_mm"),
        ({"move_seen_mm": 1e4}, "move_seen_mm"),
        ({"reason": "x" * 201}, "reason"),
        ({"because": "x"}, "because"),
    ],
)
def test_what_is_out_of_bounds_is_refused_by_name(client, session_id, running, changes, field):
    answer = client.post(f"{URL}/{session_id}/reference", json=BODY | changes)
    assert (answer.status_code, answer.json()["field"]) == (422, field)
    assert running.commands == []


def test_no_key_sets_a_reference():
    assert Permission.GATE_REFERENCE not in KEY_PERMISSIONS
    assert {role for role, may in ROLE_PERMISSIONS.items() if Permission.GATE_REFERENCE in may} == {
        Role.THERAPIST,
        Role.PHYSICIST,
    }


def test_a_session_shows_what_is_proposed(client, session_id, running):
    assert client.get(f"{URL}/{session_id}").json()["reference_proposals"] == []
    volume = SignalChoice(signal="volume")
    far = ReferenceDistance(moved_mm=8.1, levels=(SignalLevel(WHOLE, 8.0),))
    proposals = (
        ReferenceProposal(
            moment=ReferenceMoment.END_EXHALE, signal=volume, level=-0.12345, scatter=0.01, breaths=3, percent=None
        ),
        ReferenceProposal(
            moment=ReferenceMoment.END_INHALE, level=8.0, scatter=0.2, breaths=5, percent=97.12345, distance=far
        ),
    )
    shown = [one.model_dump() for one in proposal_views(LearningStatus(reference_proposals=proposals), 2.0, TOLERANCE)]
    assert shown == [
        {"at": "end_exhale", "signal": "volume", "unit": "l", "level": -0.123, "scatter": 0.01, "breaths": 3}
        | {"percent": None, "distance": None, "distance_mm": None, "is_beyond": False, "position": []},
        {"at": "end_inhale", "signal": "whole", "unit": "mm", "level": 8.0, "scatter": 0.2, "breaths": 5}
        | {"percent": 97.1235, "distance": far.text, "distance_mm": 8.1, "is_beyond": True, "position": []},
    ]
