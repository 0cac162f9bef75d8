"""The whole service on the real engine in a process of its own: measured, gated, kept, and run again from its tape."""

import cv2
import numpy as np
import pytest

from engine.motion.settings import PipelineSettings
from service.core.settings.settings import Settings
from service.engine_host.process import messages
from service.engine_host.process.process_engine import ProcessEngine
from service.sessions.recovery.replay import StoredSession
from service.storage.database.engine import Database
from service.web.app import create_app
from tests.support.engine_process.bench import eventually
from tests.support.replay.real_sessions import FEW_FRAMES, PATIENT_LIMITS
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.real_engine import detail_of, open_session, turn_on

pytestmark = pytest.mark.waiting

FILM = {"kind": "recording", "path": "recording.oni", "player": "reader"}


@pytest.fixture
def client(tmp_path, regular_volunteer, monkeypatch):
    monkeypatch.setattr(messages, "MODULE", "tests.support.engine_process.fast_recording_program")
    settings = Settings(
        data_dir=tmp_path / "data",
        recordings_dirs=(regular_volunteer,),
        allowed_hosts=("testserver",),
        max_service_silence_ms=2_000.0,
        **PATIENT_LIMITS,
    )
    learns = PipelineSettings(training=FEW_FRAMES)
    with PeopleClient(create_app(settings, lambda given: ProcessEngine(given, measuring=learns))) as held:
        yield held


def test_a_recording_is_measured_gated_and_kept_and_its_tape_gives_the_same_again(client, tmp_path, regular_volunteer):
    session_id = open_session(client, (regular_volunteer / "calibration.json").read_bytes(), source=FILM)
    assert act(client, session_id, "start").json()["status"] == "running"
    turn_on(client, session_id)
    picture = client.get(f"/api/v1/sessions/{session_id}/picture")
    shape = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR).shape
    assert (picture.status_code, shape) == (200, (480, 640, 3))
    assert int(picture.headers["X-Frame-Index"]) > 0
    mesh = client.get(f"/api/v1/sessions/{session_id}/mesh").json()
    assert len(mesh["vertices_mm"]) == mesh["rows"] * mesh["columns"]
    eventually(lambda: detail_of(client, session_id)["status"] != "running", within_s=60.0)
    detail = detail_of(client, session_id)
    assert (detail["status"], detail["summary"]["missed_frames"]) == ("ended", 0)
    assert detail["summary"]["duty_cycle"] > 0.0
    assert client.get(f"/api/v1/sessions/{session_id}/models").json()["items"], "what was learned is kept"
    (closed,) = audit_rows(client, "session.close")
    assert (len(closed["detail"]["tape_sha256"]), closed["detail"]["tape_torn"]) == (64, None)
    database = Database(tmp_path / "data" / "tidegate.db")
    verdict = StoredSession(database, tmp_path / "data", session_id).run_again(None, lambda _frames: None)
    database.close()
    assert verdict.is_identical
    assert verdict.samples == detail["summary"]["frames"]
