"""A clinical service with its routes: no camera without a measured latency is armed, and the gate counts what was."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from engine.core.commands import Arm
from service.storage.database.engine import Database
from service.web.app import create_app
from tests.support.database.migrated import with_tables
from tests.support.qa.latency_runs import CAMERA, put
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows, make_calibration, make_session_body, upload
from tests.support.service.clinical_site import CLINICAL
from tests.support.service.fake_engine import FakeRunning

CAMERAS_OWN = replace(make_calibration(), serial="A1").to_json()


@pytest.fixture
def site(settings):
    return type(settings)(**settings.model_dump(exclude_unset=True) | CLINICAL)


@pytest.fixture
def service(site, engine, migrated_file, monkeypatch):
    monkeypatch.setattr("service.web.container.refuse_without_qa", lambda *_: None)
    monkeypatch.setattr("service.monitoring.readiness.refuse_without_qa", lambda *_: None)
    own = FakeRunning.status
    monkeypatch.setattr(FakeRunning, "status", property(lambda self: replace(own.fget(self), source=CAMERA)))
    with PeopleClient(create_app(with_tables(site, migrated_file), lambda _settings: engine)) as client:
        yield client


def measured(site, **changes):
    database = Database(site.database_place)
    put(database, **{"now": datetime.now(UTC)} | changes)
    database.close()


def started(client):
    body = make_session_body(upload(client, CAMERAS_OWN).json()["id"]) | {"source": {"kind": "device"}}
    session_id = client.post("/api/v1/sessions", json=body).json()["id"]
    assert act(client, session_id, "start").status_code == 200
    return session_id


def test_arming_without_it_is_refused_before_the_engine_and_audited(service, engine):
    session_id = started(service)
    refused = act(service, session_id, "arm", state=engine.running.arming_state)
    assert (refused.status_code, refused.json()["code"]) == (409, "camera_latency")
    assert "this camera (A1) was never measured: measure it (tidegate qa latency" in refused.json()["detail"]
    assert not any(isinstance(command, Arm) for command in engine.running.commands)
    row = audit_rows(service, "session.arm")[-1]
    assert (row["outcome"], row["detail"]["code"]) == ("refused", "camera_latency")
    ready = service.get("/readyz")
    assert ready.status_code == 503
    assert "camera_latency" in [one["code"] for one in ready.json()["reasons"]]
    for harmless in ("disarm", "hold"):
        assert act(service, session_id, harmless).status_code == 200


def test_with_it_people_arm(service, site, engine):
    session_id = started(service)
    measured(site)
    act(service, session_id, "arm", state=engine.running.arming_state)
    assert any(isinstance(command, Arm) for command in engine.running.commands)


@pytest.mark.parametrize(("median_ms", "counted_ms"), [(30.0, 40.0), (80.0, 85.0)])
def test_the_session_s_gate_counts_the_larger_of_both_and_the_audit_states_it(
    service, site, engine, median_ms, counted_ms
):
    measured(site, median_ms=median_ms)
    started(service)
    assert engine.running.plan.camera_latency_ms == counted_ms
    assert audit_rows(service, "session.start")[-1]["detail"]["camera_latency_ms"] == counted_ms


def test_a_latency_that_the_gate_cannot_accept_refuses_the_start(service, site):
    measured(site, median_ms=296.0)
    body = make_session_body(upload(service, CAMERAS_OWN).json()["id"]) | {"source": {"kind": "device"}}
    session_id = service.post("/api/v1/sessions", json=body).json()["id"]
    refused = act(service, session_id, "start")
    assert (refused.status_code, refused.json()["field"]) == (422, "camera_latency_ms")


def test_the_list_has_each_camera_with_what_the_mode_states_of_it(service, site):
    assert service.get("/api/v1/qa/latency").json() == {"configured_ms": 40.0, "max_age_days": 365.0, "items": []}
    measured(site)
    measured(site, camera=replace(CAMERA, serial="B2"), median_ms=90.0)
    found = {one["camera"]["serial"]: one for one in service.get("/api/v1/qa/latency").json()["items"]}
    assert found["A1"]["refusal"] is None
    assert (found["A1"]["median_ms"], found["A1"]["uncertainty_ms"], found["A1"]["counted_ms"]) == (30.0, 5.0, 35.0)
    assert "set TIDEGATE_CAMERA_LATENCY_MS to 95" in found["B2"]["refusal"]
