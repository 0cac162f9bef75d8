"""A session made under one set of settings and started under another: it is the site's rules of now that count."""

import pytest

from engine.core.errors import TidegateError
from service.core.schemas import sessions
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.local_engine import LocalEngine
from service.engine_host.protocols import SessionPlan
from service.sessions.lifecycle import start
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import WINDOW, act, audit_rows, make_calibration, make_session_body, upload

HOLD = {"kind": "breath_hold", "lower_mm": 8.0, "upper_mm": 12.0}
PHASE = {"kind": "phase", "from_percent": 30.0, "to_percent": 70.0}

NARROWED = [
    (WINDOW, {"min_dwell_ms": 500.0}, "window.dwell_ms"),
    (WINDOW | {"min_off_ms": 0.0}, {"min_off_ms": 1000.0}, "window.min_off_ms"),
    (WINDOW | {"max_cycles_per_min": 120}, {"max_cycles_per_min": 30}, "window.max_cycles_per_min"),
    (WINDOW, {"window_upper_mm": 2.9}, "window.upper_mm"),
    (WINDOW | {"join": "or", "further": [PHASE]}, {"window_upper_mm": 20.0}, "window.further.0.kind"),
    (HOLD, {"max_breath_hold_s": 20.0}, "window.timeout_s"),
    (PHASE, {"min_phase_confidence": 0.8}, "window.min_confidence"),
]


@pytest.mark.parametrize(("window", "narrowed", "field"), NARROWED, ids=[field for _, _, field in NARROWED])
def test_a_session_is_started_within_the_site_s_limits_of_now_or_not_at_all(settings, window, narrowed, field):
    with PeopleClient(create_app(settings)) as client:
        calibration_id = upload(client, make_calibration().to_json()).json()["id"]
        made = client.post("/api/v1/sessions", json=make_session_body(calibration_id) | {"window": window})
        session_id = made.json()["id"]
    with PeopleClient(create_app(settings.model_copy(update=narrowed))) as client:
        answer = act(client, session_id, "start")
        assert (answer.status_code, answer.json()["field"]) == (422, field)
        assert client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "failed"
        assert audit_rows(client, "session.start")[-1]["outcome"] == "refused"


def test_a_camera_s_own_registration_is_not_started_on_once_the_site_forbids_it():
    plan = SessionPlan(
        session_id="0" * 32,
        source=sessions.DeviceSource(kind="device"),
        recording=None,
        calibration=make_calibration("device registration: unit 1"),
        window=Window.model_validate(WINDOW),
    )
    assert plan.calibration.is_device_registration
    with pytest.raises(TidegateError, match="does not allow a camera's own registration"):
        LocalEngine(Settings(allow_device_registration=False)).open(plan)


@pytest.mark.parametrize("is_simulated", [True, False])
def test_a_session_states_of_its_beam_what_is_so_when_it_starts(client, session_id, engine, is_simulated):
    engine.is_simulated_beam = is_simulated
    assert act(client, session_id, "start").json()["is_simulated_beam"] is is_simulated
    assert client.get(f"/api/v1/sessions/{session_id}").json()["is_simulated_beam"] is is_simulated


def test_a_library_that_is_loaded_when_used_is_there_before_a_session_runs(client, session_id, engine, monkeypatch):
    loaded = []
    monkeypatch.setattr(start, "load_now", lambda: loaded.append(engine.opened[:]))
    assert act(client, session_id, "start").status_code == 200
    assert loaded == [[]]
    assert len(engine.opened) == 1
