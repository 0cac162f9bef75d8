"""Sessions of a clinical site: what is outside of its bounds is refused with field, value and bound."""

import pytest

from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import WINDOW, audit_rows, make_session_body, upload
from tests.support.service.clinical_site import CLINICAL


@pytest.fixture
def client(settings, engine):
    site = type(settings)(**settings.model_dump(exclude_unset=True) | CLINICAL)
    with PeopleClient(create_app(site, lambda _settings: engine)) as client:
        yield client


@pytest.fixture
def body(client, calibration_text):
    calibration_id = upload(client, calibration_text).json()["id"]
    return make_session_body(calibration_id) | {"source": {"kind": "device"}}


def test_a_session_within_the_bounds_is_created_and_the_audit_has_mode_and_dead_man(client, body):
    assert client.post("/api/v1/sessions", json=body).status_code == 201
    detail = audit_rows(client, "service.start")[0]["detail"]
    assert (detail["mode"], detail["hardware_dead_man"]) == ("clinical", True)


@pytest.mark.parametrize(
    ("change", "field", "value", "bound"),
    [
        ({"dwell_ms": 0.0}, "window.dwell_ms", "0.0", "at least 100"),
        ({"dwell_ms": 99.9}, "window.dwell_ms", "99.9", "at least 100"),
        ({"lower_mm": -100.0}, "window.lower_mm", "-100.0", "at least -5"),
        ({"upper_mm": 100.0}, "window.upper_mm", "100.0", "at most 30"),
        (
            {"kind": "breath_hold", "timeout_s": 60.0},
            "window.timeout_s",
            "60.0",
            "at most 40",
        ),
        ({"further": [{"lower_mm": -50.0, "upper_mm": 1.0}]}, "window.further.0.lower_mm", "-50.0", "at least -5"),
    ],
    ids=str,
)
def test_a_session_outside_of_the_bounds_is_refused_by_name_value_and_bound(client, body, change, field, value, bound):
    answer = client.post("/api/v1/sessions", json=body | {"window": WINDOW | change})
    assert (answer.status_code, answer.json()["field"], answer.json()["value"]) == (422, field, value), answer.text
    assert bound in answer.json()["bound"]
    assert client.get("/api/v1/sessions").json()["items"] == []


def test_a_recording_and_a_phase_alone_gate_nothing(client, body):
    recording = body | {"source": {"kind": "recording", "path": "chest.oni", "player": "auto"}}
    assert client.post("/api/v1/sessions", json=recording).json()["field"] == "source.kind"
    phase = body | {"window": {"kind": "phase", "from_percent": 30.0, "to_percent": 70.0, "dwell_ms": 200.0}}
    assert client.post("/api/v1/sessions", json=phase).json()["field"] == "window.kind"
