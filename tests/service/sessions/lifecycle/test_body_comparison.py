"""The body is compared with the patient's earlier session, always: shown, audited and streamed, and nothing is held."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from engine.core.gate_state import HoldReason
from engine.core.motion_model import MotionModel
from engine.motion.learning.patient_match import PatientMatchLimits
from service.sessions.lifecycle.body_comparison import EarlierBody, compare_bodies, earlier_body
from service.sessions.views.live import live_sample
from service.storage.database.engine import Database
from service.storage.database.queries import RetriedWriter
from service.storage.files.motion_models import MODELS_FOLDER, ModelStore
from tests.support.service.api_calls import act, audit_rows, make_session_body
from tests.support.service.fake_engine import make_model
from tests.support.waiting import eventually

URL = "/api/v1/sessions"
LIMITS = PatientMatchLimits()
_x, _y = np.meshgrid(np.linspace(-100.0, 100.0, 21), np.linspace(-150.0, 150.0, 36))
SURFACE = np.stack([_x, _y, 850.0 + 0.002 * _x**2 + 0.0005 * _y**2], axis=-1).reshape(-1, 3)
OTHER_BODY = SURFACE + np.stack([0 * _x, 0 * _y, 12.0 * np.sin(_x / 25.0) * np.sin(_y / 40.0)], axis=-1).reshape(-1, 3)
EARLIER = EarlierBody(session_id="1" * 32, model_id="2" * 32, surface_mm=SURFACE, calibration_sha256="0" * 64)


def model(surface_mm, seed=1, **changes):
    return replace(make_model(seed), surface_mm=surface_mm, **changes)


def turned(degrees: float):
    angle = np.deg2rad(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return (SURFACE - SURFACE.mean(axis=0)) @ rotation.T + SURFACE.mean(axis=0)


def test_the_same_body_in_the_same_place_is_no_warning():
    found = compare_bodies(EARLIER, model(SURFACE + np.array([3.0, -4.0, 0.0])), LIMITS)
    assert found.warning is None
    assert found.shift_mm == pytest.approx((3.0, -4.0, 0.0), abs=1e-6)
    assert (found.shape_mm, found.tilt_deg) == pytest.approx((0.0, 0.0), abs=1e-3)


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (OTHER_BODY, "another patient, or markers at other places"),
        (SURFACE + np.array([0.0, 30.0, 0.0]), "lies 30 mm from there, 20 mm allowed"),
        (turned(12.0), "turned by 12 deg, 5 deg allowed"),
    ],
)
def test_another_body_or_place_is_a_warning_with_figure_and_bound(surface, words):
    assert words in compare_bodies(EARLIER, model(surface), LIMITS).warning


def test_the_warning_is_in_every_sample_of_the_stream(client, running):
    running.frame()
    match = compare_bodies(EARLIER, model(OTHER_BODY), LIMITS)
    for body, warning in ((match, match.warning), (replace(match, warning=None), None), (None, None)):
        sample = live_sample(running.latest, running.plan, is_stopping=False, is_simulated_beam=True, body=body)
        assert sample.body_warning == warning


def test_with_another_calibration_only_the_shape_counts():
    moved = model(SURFACE + np.array([0.0, 80.0, 0.0]), calibration_sha256="1" * 64)
    found = compare_bodies(EARLIER, moved, LIMITS)
    assert (found.warning, found.is_position_compared) == (None, False)
    other = model(OTHER_BODY, calibration_sha256="1" * 64)
    assert "another patient" in compare_bodies(EARLIER, other, LIMITS).warning


def test_too_little_of_the_body_is_not_compared():
    hidden = SURFACE.copy()
    hidden[10:] = np.nan
    for surface in (None, SURFACE[:-1], hidden):
        assert compare_bodies(EARLIER, model(surface), LIMITS) is None


def learned_session(client, engine, calibration_id, surface, seed, **changes):
    """Run a session that learns a model, and return its description and audited comparison while it runs."""
    body = make_session_body(calibration_id) | changes
    session_id = client.post(URL, json=body).json()["id"]
    assert act(client, session_id, "start").status_code == 200
    engine.running.frame()
    engine.running.model = model(surface, seed)
    eventually(lambda: client.get(f"{URL}/{session_id}").json()["active_model_id"] is not None)
    detail = client.get(f"{URL}/{session_id}").json()
    act(client, session_id, "stop")
    rows = [row["detail"] for row in audit_rows(client, "session.body") if row["session_id"] == session_id]
    return detail, rows


@pytest.mark.both_databases
def test_a_later_session_of_the_patient_is_compared_and_nothing_is_held(client, engine, calibration_id):
    first, rows = learned_session(client, engine, calibration_id, SURFACE, 1)
    assert (first["body"], rows) == (None, [])
    second, (row,) = learned_session(client, engine, calibration_id, OTHER_BODY, 2)
    assert "another patient" in second["body"]["warning"]
    assert second["body"]["session_id"] == first["id"] == row["earlier_session_id"]
    assert row["warning"] == second["body"]["warning"]
    # A database that answers late under load holds by itself: the comparison may not.
    assert set(engine.running.faults) <= {HoldReason.AUDIT_BEHIND}
    same, (row,) = learned_session(client, engine, calibration_id, OTHER_BODY, 3)
    assert (same["body"]["warning"], row["warning"], row["earlier_session_id"]) == (None, None, second["id"])


def test_a_model_is_shown_together_with_its_comparison(client, engine, calibration_id, monkeypatch):
    """Between the commit of both and the writer's next statement a reader sees neither."""
    learned_session(client, engine, calibration_id, SURFACE, 1)
    write, is_written, is_read = RetriedWriter.write, threading.Event(), threading.Event()

    def stopped_after(writer, subject, record):
        write(writer, subject, record)
        if isinstance(subject, MotionModel):
            is_written.set()
            assert is_read.wait(30.0)

    monkeypatch.setattr(RetriedWriter, "write", stopped_after)
    session_id = client.post(URL, json=make_session_body(calibration_id)).json()["id"]
    assert act(client, session_id, "start").status_code == 200
    engine.running.frame()
    engine.running.model = model(OTHER_BODY, 2)
    assert is_written.wait(30.0)
    between = client.get(f"{URL}/{session_id}").json()
    is_read.set()
    assert (between["active_model_id"], between["body"]) == (None, None)
    eventually(lambda: client.get(f"{URL}/{session_id}").json()["active_model_id"] is not None)
    assert "another patient" in client.get(f"{URL}/{session_id}").json()["body"]["warning"]


def test_another_patient_s_sessions_are_not_compared(client, engine, calibration_id):
    learned_session(client, engine, calibration_id, SURFACE, 1)
    other, rows = learned_session(client, engine, calibration_id, OTHER_BODY, 2, patient_reference="P-0002")
    assert (other["body"], rows) == (None, [])


def test_a_model_whose_file_is_gone_is_not_compared(client, engine, calibration_id, settings):
    learned_session(client, engine, calibration_id, SURFACE, 1)
    for file in (settings.data_dir / MODELS_FOLDER).iterdir():
        file.unlink()
    database = Database(settings.database_place)
    models = ModelStore(settings.data_dir / MODELS_FOLDER)
    assert earlier_body(database, models, session_id="0" * 32, patient_reference="P-0001") is None
    database.close()
