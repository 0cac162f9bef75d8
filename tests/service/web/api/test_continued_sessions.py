"""A session that continues an earlier one: the delivered time is kept, and nothing else is taken over."""

import json

import pytest

from engine.core.gate_state import GateState, HoldReason
from service.storage.database.engine import Database
from service.storage.database.tables import SessionRow
from tests.support.service.api_calls import act
from tests.support.service.fake_engine import FRAME_NS
from tests.support.waiting import eventually

FIVE_S = pytest.approx(150 * FRAME_NS / 1e9, abs=0.001)


def detail(client, session_id):
    return client.get(f"/api/v1/sessions/{session_id}").json()


def create(client, body, **changes):
    return client.post("/api/v1/sessions", json=body | changes)


def run(client, engine, session_id, frames: int = 150) -> None:
    """Start a session, deliver, and stop it."""
    assert act(client, session_id, "start").status_code == 200
    engine.running.transition(GateState.BEAM_ON)
    for _ in range(frames):
        engine.running.frame(line_on=True)
    engine.running.transition(GateState.HOLD, HoldReason.OUTSIDE_WINDOW)
    engine.running.frame()
    eventually(lambda: detail(client, session_id)["summary"]["frames"] == frames + 1)
    assert act(client, session_id, "stop").status_code == 200


@pytest.fixture
def earlier(client, engine, session_id):
    run(client, engine, session_id)
    return session_id


def refused(answer, *, status: int = 422) -> str:
    assert answer.status_code == status
    assert answer.json()["field"] == "continues"
    return answer.json()["detail"]


def test_the_delivered_time_is_kept_over_any_number_of_sessions(client, engine, session_body, earlier):
    second = create(client, session_body, continues=earlier).json()
    assert second["continues"] == earlier
    assert detail(client, second["id"])["delivered_before_s"] == FIVE_S
    run(client, engine, second["id"], 150)
    third = create(client, session_body, continues=second["id"]).json()["id"]
    assert detail(client, third)["delivered_before_s"] == pytest.approx(300 * FRAME_NS / 1e9, abs=0.002)
    assert detail(client, earlier)["delivered_before_s"] is None
    (row,) = client.get(f"/api/v1/audit?action=session.create&session_id={third}").json()["items"]
    assert row["detail"]["continues"] == second["id"]
    assert row["detail"]["delivered_before_s"] == detail(client, third)["delivered_before_s"]


def test_neither_arming_nor_a_reference_nor_a_model_is_taken_over(client, engine, session_body, earlier):
    second = create(client, session_body, continues=earlier).json()
    assert second["model_id"] is None
    act(client, second["id"], "start")
    assert engine.running.plan.model is None
    assert engine.running.commands == []
    engine.running.frame()
    assert detail(client, second["id"])["gate"]["is_armed"] is False


@pytest.mark.parametrize("field", ["patient_reference", "plan_id", "fraction_id"])
def test_another_fraction_is_refused_without_its_values(client, session_body, earlier, field):
    text = refused(create(client, session_body | {field: "ANOTHER-1"}, continues=earlier))
    assert field in text
    assert str(session_body[field]) not in text


def test_another_fraction_number_is_refused(client, session_body, earlier):
    assert "fraction_number" in refused(create(client, session_body, fraction_number=17, continues=earlier))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("window", {"signal": "whole", "lower_mm": -1.0, "upper_mm": 8.0}),
        ("head_direction", "bottom"),
        ("regions", {"extra_markers": True}),
    ],
)
def test_another_gate_is_no_continuation(client, session_body, earlier, field, value):
    assert field in refused(create(client, session_body | {field: value}, continues=earlier))


def test_a_simulated_beam_is_no_time_of_a_real_one(client, engine, session_body, earlier):
    engine.is_simulated_beam = False
    assert "is_simulated_beam" in refused(create(client, session_body, continues=earlier))


def test_what_is_not_over_or_was_never_started_or_does_not_exist_is_refused(client, session_body):
    refused(create(client, session_body, continues="00" * 16), status=404)
    never = create(client, session_body).json()["id"]
    act(client, never, "stop")
    assert "started" in refused(create(client, session_body, continues=never))


def test_a_session_is_continued_once_and_a_continuation_that_never_started_does_not_count(
    client, engine, session_body, earlier
):
    never = create(client, session_body, continues=earlier).json()["id"]
    act(client, never, "stop")
    second = create(client, session_body, continues=earlier).json()["id"]
    run(client, engine, second, 3)
    assert second in refused(create(client, session_body, continues=earlier))


def test_a_time_that_an_earlier_version_did_not_count_is_unknown_not_zero(client, settings, session_body, earlier):
    database = Database(settings.database_place)
    with database.write() as db:
        row = db.get(SessionRow, earlier)
        kept = json.loads(row.summary)
        del kept["beam_on_s"]
        row.summary = json.dumps(kept)
    database.close()
    second = create(client, session_body, continues=earlier).json()["id"]
    assert detail(client, second)["delivered_before_s"] is None


def test_an_id_that_is_none_is_refused(client, session_body):
    assert create(client, session_body, continues="no id").status_code == 422
