"""A patient's second fraction on the real engine: begun with the first one's model, compared, and armed by a person."""

import pytest

from engine.capture.recording_source import OniFileSource
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.settings import PipelineSettings
from service.core.settings.settings import Settings
from service.engine_host.local_engine import LocalEngine
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import PRESENT, act, audit_rows
from tests.support.service.real_engine import PATIENT_LIMITS, arm_when_ready, detail_of, open_session
from tests.support.waiting import eventually

MEASURING = PipelineSettings(
    training=TrainingSettings(min_frames=50, max_frames=120, min_cycles=1, min_seconds=5.0),
    likeness=PatientMatchLimits(seconds=1.0),
)
SOURCE = {"kind": "recording", "path": "recording.oni", "player": "reader"}


class PatientEngine(LocalEngine):
    """Plays as fast as frames can be measured, or in real time, so that a person has time to act."""

    is_paced = False

    def __init__(self, settings):
        super().__init__(settings, measuring=MEASURING)

    def _player(self, path, _player):
        return OniFileSource(path, clock=self._clock, is_paced=PatientEngine.is_paced)


@pytest.fixture
def client(tmp_path, regular_volunteer):
    settings = Settings(
        data_dir=tmp_path / "data",
        recordings_dirs=(regular_volunteer,),
        allowed_hosts=("testserver",),
        **PATIENT_LIMITS,
    )
    with PeopleClient(create_app(settings, PatientEngine)) as client:
        yield client


def first_fraction(client, calibration_text):
    """Learn a model, and close the session; returns the model."""
    PatientEngine.is_paced = False
    session_id = open_session(client, calibration_text, source=SOURCE)
    act(client, session_id, "start")
    url = f"/api/v1/sessions/{session_id}/models"
    eventually(lambda: len(client.get(url).json()["items"]) == 1, within_s=60.0)
    act(client, session_id, "stop")
    return client.get(url).json()["items"][0]


def refused_arming(client, session_id):
    """Return why arming is refused, but for faults of a busy machine, which are acknowledged, as a person would."""
    while (refused := act(client, session_id, "arm")).status_code == 409:
        if "fault is latched" not in refused.json()["detail"]:
            break
        act(client, session_id, "acknowledge")
    return refused


def test_the_second_fraction_begins_with_the_first_one_s_model_and_a_person_s_reference(client, regular_volunteer):
    calibration_text = (regular_volunteer / "calibration.json").read_bytes()
    model = first_fraction(client, calibration_text)
    assert model["quality"]["amplitude_mm"] > 4.0
    assert model["settings"]["min_cycles"] == 1.0
    PatientEngine.is_paced = True
    session_id = open_session(client, calibration_text, source=SOURCE, model_id=model["id"], fraction_id="FX-4")
    act(client, session_id, "start")
    eventually(lambda: detail_of(client, session_id)["likeness"] is not None, within_s=30.0)
    detail = detail_of(client, session_id)
    assert detail["likeness"]["is_accepted"]
    assert detail["likeness"]["shape_mm"] < 2.0
    assert not detail["has_reference"]
    refused = refused_arming(client, session_id)
    assert (refused.status_code, refused.json()["code"]) == (409, "command_refused")
    assert "reference" in refused.json()["detail"]
    assert act(client, session_id, "reference", operator="B. Physicist").status_code == 200
    eventually(lambda: detail_of(client, session_id)["has_reference"])
    arm_when_ready(client, session_id)
    act(client, session_id, "stop")
    reported = {row["action"]: row["detail"] for row in audit_rows(client) if row["session_id"] == session_id}
    assert reported["model.compared"]["is_accepted"]
    assert "set it before arming" in reported["model.zero_needed"]["detail"]
    assert reported["model.in_use"]["sha256"] == model["sha256"]
    assert reported["session.reference"]["reason"] == PRESENT["reason"]
