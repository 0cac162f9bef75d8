"""The whole service on the real engine: a volunteer's recording, from upload to the closed session."""

import csv
import io
import json

import cv2
import numpy as np
import pytest

from engine.capture import drivers
from service.core.settings.settings import Settings
from service.engine_host import beam_lines
from service.engine_host.local_engine import LocalEngine
from service.storage.samples.store import SampleStore
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows, make_calibration
from tests.support.service.real_engine import (
    PATIENT_LIMITS,
    WIDE,
    HurriedEngine,
    arm_when_ready,
    detail_of,
    open_session,
    turn_on,
)
from tests.support.waiting import eventually

pytestmark = pytest.mark.alone


@pytest.fixture
def real_client(tmp_path, regular_volunteer):
    settings = Settings(
        data_dir=tmp_path / "data",
        recordings_dirs=(regular_volunteer,),
        allowed_hosts=("testserver",),
        **PATIENT_LIMITS,
    )
    with PeopleClient(create_app(settings, HurriedEngine)) as client:
        client.data_dir = settings.data_dir
        yield client


def test_a_recording_is_learned_gated_recorded_and_audited(real_client, regular_volunteer):
    client = real_client
    source = {"kind": "recording", "path": "recording.oni", "player": "reader"}
    session_id = open_session(client, (regular_volunteer / "calibration.json").read_bytes(), source=source)
    assert act(client, session_id, "start").json()["status"] == "running"
    assert act(client, session_id, "arm").status_code == 409, "nothing is learned yet"
    with client.websocket_connect("/api/v1/live") as socket:
        eventually(lambda: json.loads(socket.receive_text())["type"] == "sample", within_s=20.0)
        picture = client.get(f"/api/v1/sessions/{session_id}/picture")
    shape = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR).shape
    assert shape == (480, 640, 3)
    turn_on(client, session_id)
    eventually(lambda: detail_of(client, session_id)["status"] != "running", within_s=60.0)
    detail = detail_of(client, session_id)
    assert (detail["status"], detail["summary"]["missed_frames"]) == ("ended", 0)
    assert detail["summary"]["duty_cycle"] > 0.0
    states = [row["detail"]["to_state"] for row in audit_rows(client, "gate.transition")]
    assert "beam_on" in states
    assert states[-1] != "beam_on"
    _check_samples(client, session_id, detail["summary"]["frames"])
    model, *_ = client.get(f"/api/v1/sessions/{session_id}/models").json()["items"]
    share = client.get(f"/api/v1/models/{model['id']}/spectrum").json()["share"]
    assert share[0] > 0.8
    assert sum(share) == pytest.approx(1.0)
    assert client.get("/api/v1/audit/verify").json()["is_intact"]


BELLY = {"name": "belly", "vertices": [[220.0, 40.0], [220.0, 160.0], [320.0, 100.0]]}
ANYWHERE = {
    "signal": "point",
    "row": 250,
    "column": 100,
    "lower_percent": -90,
    "upper_percent": 290,
    "hysteresis_percent": 0,
    "dwell_ms": 100.0,
    "further": [
        {"signal": "named", "name": "belly", "lower_mm": -40.0, "upper_mm": 40.0},
        {"signal": "volume", "lower_l": -5.0, "upper_l": 5.0},
    ],
}
"""A window that holds no one back and looks at a point, a region of the session's own and the volume."""


def test_a_window_of_many_conditions_is_settled_gated_held_and_released(real_client, regular_volunteer):
    client = real_client
    source = {"kind": "recording", "path": "recording.oni", "player": "reader"}
    calibration = (regular_volunteer / "calibration.json").read_bytes()
    wishes = {"source": source, "window": ANYWHERE, "regions": {"named": [BELLY]}}
    session_id = open_session(client, calibration, **wishes)
    act(client, session_id, "start")
    arm_when_ready(client, session_id)
    gate_window = detail_of(client, session_id)["gate_window"]
    assert [one["unit"] for one in gate_window["conditions"]] == ["mm", "mm", "l"]
    assert gate_window["conditions"][0]["lower"] < gate_window["conditions"][0]["upper"]
    act(client, session_id, "hold", operator="C. Nurse")
    held = detail_of(client, session_id)
    assert (held["gate"]["operator_hold"], held["gate"]["line_on"]) == ("C. Nurse", False)
    assert held["breath"]["signal"] == "point 250,100"
    assert act(client, session_id, "presence").status_code == 204
    act(client, session_id, "release")
    eventually(lambda: detail_of(client, session_id)["status"] != "running", within_s=60.0)
    moves = [row["detail"] for row in audit_rows(client, "gate.transition")]
    states = [(one["to_state"], one["reason"]) for one in moves]
    at = next(place for place, (_, reason) in enumerate(states) if reason == "operator_hold")
    assert ("beam_on", None) in states[at:], "released, and on again after a dwell"
    assert all(one["latency_ms"] > 0.0 for one in moves if one["captured_ns"] is not None)
    assert detail_of(client, session_id)["summary"]["latency"]["max_ms"] > 0.0


PER_CENT = {"lower_percent": -50, "upper_percent": 250, "dwell_ms": 100.0}


@pytest.mark.parametrize(
    ("site", "window", "fields", "bound"),
    [
        (
            {"window_lower_mm": -0.5, "window_upper_mm": 0.5},
            PER_CENT,
            {"window.lower_mm", "window.upper_mm"},
            "the site's limit",
        ),
        ({"max_duty_percent": 90.0}, WIDE, {"window"}, "100 % of the learned breaths lie inside, and at most 90 % may"),
    ],
    ids=["beyond the site's edges once in mm", "never left by the patient"],
)
def test_a_window_is_refused_at_arming(tmp_path, regular_volunteer, site, window, fields, bound):
    settings = Settings(
        data_dir=tmp_path / "data",
        recordings_dirs=(regular_volunteer,),
        allowed_hosts=("testserver",),
        **PATIENT_LIMITS | site,
    )
    source = {"kind": "recording", "path": "recording.oni", "player": "reader"}
    with PeopleClient(create_app(settings, HurriedEngine)) as client:
        calibration = (regular_volunteer / "calibration.json").read_bytes()
        session_id = open_session(client, calibration, source=source, window=window)
        act(client, session_id, "start")
        eventually(lambda: detail_of(client, session_id)["measurement_state"] == "measuring", within_s=60.0)
        act(client, session_id, "reference")
        eventually(lambda: detail_of(client, session_id)["has_reference"])
        assert detail_of(client, session_id)["predicted_duty_percent"] == 100.0
        answer = act(client, session_id, "arm")
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid_value"), answer.text
        assert answer.json()["field"] in fields
        assert bound in answer.json()["bound"]
        act(client, session_id, "stop")
        assert "hold" not in {row["detail"]["to_state"] for row in audit_rows(client, "gate.transition")}


def _check_samples(client, session_id, frames):
    rows = list(csv.DictReader(io.StringIO(client.get(f"/api/v1/sessions/{session_id}/samples").text)))
    assert [int(row["frame_index"]) for row in rows] == list(range(frames))
    measured = [row for row in rows if row["state"] == "measuring"]
    assert len(measured) > 50
    assert all(abs(float(row["whole_mm"])) < 40.0 for row in measured)
    assert all(row["whole_mm"] == "" for row in rows if row["state"] != "measuring")
    assert {row["gate"] for row in rows} >= {"disarmed", "beam_on"}
    assert all(int(row["received_ns"]) <= int(row["decided_ns"]) <= int(row["asserted_ns"]) for row in rows)
    for batch in SampleStore(client.data_dir / "samples").batches(session_id):
        on = zip(batch["line_on"].to_pylist(), batch["gate"].to_pylist(), strict=True)
        assert all(gate == "beam_on" for line_on, gate in on if line_on)


CALLS = (
    *("arm", "reference", "acknowledge", "hold", "release", "disarm", "arm", "presence", "start", "models/retrain"),
    *("hold", "release", "arm"),
)


def test_no_call_turns_the_beam_on_while_nothing_can_be_measured(tmp_path, regular_volunteer, monkeypatch):
    """Every changing call there is, again and again, on a running engine that has learned nothing."""
    lines = []

    class WatchedLine(beam_lines.SimulatedBeamLine):
        def __init__(self, clock):
            super().__init__(clock)
            self.permits = 0
            lines.append(self)

        def permit(self, lease):
            self.permits += 1
            super().permit(lease)

    monkeypatch.setattr(beam_lines, "SimulatedBeamLine", WatchedLine)
    settings = Settings(data_dir=tmp_path / "data", recordings_dirs=(regular_volunteer,), allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings, LocalEngine)) as client:
        source = {"kind": "recording", "path": "recording.oni", "player": "reader"}
        session_id = open_session(client, (regular_volunteer / "calibration.json").read_bytes(), source=source)
        act(client, session_id, "start")
        for _ in range(5):
            for action in CALLS:
                act(client, session_id, action)
            client.post(f"/api/v1/models/{'0' * 32}/activate", json={"operator": "me"})
            by = {"operator": "me", "by_mm": 1.0, "drift_mm": 1.0}
            client.post(f"/api/v1/sessions/{session_id}/baseline-correction", json=by)
            assert not lines[0].is_on()
        act(client, session_id, "stop")
    assert lines[0].permits == 0
    assert not lines[0].is_on()


@pytest.mark.parametrize("player", ["reader", "openni", "auto"])
@pytest.mark.parametrize("content", [b"", b"not a recording", b"version https://git-lfs.github.com/spec/v1\n"], ids=str)
def test_a_file_that_is_no_recording_fails_the_start_with_one_line(tmp_path, content, player):
    (tmp_path / "broken.oni").write_bytes(content)
    settings = Settings(data_dir=tmp_path / "data", recordings_dirs=(tmp_path,), allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings)) as client:
        source = {"kind": "recording", "path": "broken.oni", "player": player}
        session_id = open_session(client, make_calibration().to_json(), source=source)
        answer = act(client, session_id, "start")
        assert (answer.status_code, answer.json()["code"]) == (422, "source_unusable")
        assert len(answer.json()["detail"].splitlines()) == 1
        assert detail_of(client, session_id)["status"] == "failed"


@pytest.mark.parametrize("uri", [None, "1d27/0601@1/2", "recording.oni"])
def test_a_camera_that_is_not_there_and_a_file_called_a_camera_are_refused(real_client, regular_volunteer, uri):
    uri = str(regular_volunteer / uri) if uri == "recording.oni" else uri
    session_id = open_session(real_client, make_calibration().to_json(), source={"kind": "device", "uri": uri})
    answer = act(real_client, session_id, "start")
    assert (answer.status_code, answer.json()["code"]) == (503, "source_lost")


def test_a_missing_runtime_is_stated_and_auto_falls_back_to_our_reader(tmp_path, regular_volunteer, monkeypatch):
    for driver in {type(one) for one in drivers.CAMERAS}:
        monkeypatch.setattr(driver, "is_available", lambda _driver: False)
    settings = Settings(data_dir=tmp_path / "data", recordings_dirs=(regular_volunteer,), allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings)) as client:
        devices = client.get("/api/v1/devices").json()
        assert (devices["is_runtime_available"], devices["items"]) == (False, [])
        assert all(one.install_hint in devices["detail"] for one in drivers.CAMERAS)
        source = {"kind": "recording", "path": "recording.oni", "player": "openni"}
        session_id = open_session(client, make_calibration().to_json(), source=source)
        answer = act(client, session_id, "start")
        assert (answer.status_code, answer.json()["code"]) == (503, "openni_missing")
        session_id = open_session(client, make_calibration().to_json(), source=source | {"player": "auto"})
        assert act(client, session_id, "start").status_code == 200
        act(client, session_id, "stop")
