"""Models over the API: learned again, applied, carried to a later fraction of the same patient, and audited."""

from dataclasses import replace

import numpy as np
import pytest
from sqlalchemy import text

from engine.core.commands import ApplyModel, Retrain
from engine.core.errors import CommandRefusedError, InvalidValueError, ModelMismatchError
from engine.core.learning_status import LearningEvent, LearningEventKind, PatientMatch
from engine.core.motion_model import ModelOrigin
from engine.motion.learning.model_file import load_model, save_model
from engine.motion.learning.patient_match import PATIENT_MATCH_BOUNDS, PatientMatchLimits
from engine.motion.learning.trainer import TRAINING_BOUNDS, TrainingSettings
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.engine_host.local_engine import LocalEngine
from service.storage.database.engine import Database
from service.storage.files.motion_models import ModelStore
from tests.support.service.api_calls import act, audit_rows, edited, make_session_body, upload
from tests.support.service.fake_engine import make_model
from tests.support.service.model_events import SWAPPED
from tests.support.site_settings import give_settings
from tests.support.waiting import eventually

pytestmark = [pytest.mark.both_databases, pytest.mark.slow]

REFUSED = LearningEvent(
    kind=LearningEventKind.REFUSED,
    detail="training.amplitude_mm is 0.10: must be at least 0.60; nothing breathes",
    timestamp_us=2_000,
    figures={"code": "training_refused", "field": "training.amplitude_mm", "value": "0.10", "bound": "at least 0.60"},
)


def detail_of(client, session_id):
    return client.get(f"/api/v1/sessions/{session_id}").json()


@pytest.fixture
def kept_model(client, session_id, running):
    """A model learned in a session that is over."""
    running.model = make_model(1)
    url = f"/api/v1/sessions/{session_id}/models"
    eventually(lambda: len(client.get(url).json()["items"]) == 1)
    (model,) = client.get(url).json()["items"]
    act(client, session_id, "stop")
    return model


def created(client, calibration_id, model_id, **changes):
    return client.post("/api/v1/sessions", json={**make_session_body(calibration_id), "model_id": model_id, **changes})


# -- learning again -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keeps", [True, False])
def test_retraining_states_whether_the_reference_is_kept_and_is_audited(client, session_id, running, keeps):
    body = {"operator": "A. Physicist", "keeps_reference": keeps}
    assert client.post(f"/api/v1/sessions/{session_id}/models/retrain", json=body).status_code == 202
    assert running.commands == [Retrain(operator="A. Physicist", keeps_zero=keeps)]
    rows = audit_rows(client, "model.retrain")
    assert [row["outcome"] for row in rows] == ["requested", "done"]
    assert rows[-1]["detail"] == {"keeps_reference": keeps}


def test_retraining_keeps_the_reference_unless_requested_otherwise(client, session_id, running):
    act(client, session_id, "models/retrain")
    assert running.commands[0].keeps_zero


def test_a_waiting_model_is_applied_by_a_named_person_and_a_refusal_is_audited(client, session_id, running):
    assert act(client, session_id, "models/apply").status_code == 200
    assert running.commands == [ApplyModel(operator="A. Therapist")]
    running.refuse_with = CommandRefusedError("no new model waits to be applied")
    answer = act(client, session_id, "models/apply")
    assert (answer.status_code, answer.json()["code"]) == (409, "command_refused")
    assert [row["outcome"] for row in audit_rows(client, "model.apply")] == [
        "requested", "done", "requested", "refused",
    ]  # fmt: skip


def test_notices_of_the_learning_are_audited_with_both_values_and_no_person(client, session_id, running):
    running.notices.put(SWAPPED)
    running.notices.put(REFUSED)
    eventually(lambda: audit_rows(client, "model.refused"))
    (swapped,), (refused,) = audit_rows(client, "model.swapped"), audit_rows(client, "model.refused")
    assert (swapped["actor"], swapped["outcome"], swapped["session_id"]) == ("tidegate", "done", session_id)
    assert swapped["detail"]["zero_before_mm"] == 850.01
    assert swapped["detail"]["zero_after_mm"] == 850.03
    assert refused["outcome"] == "refused"
    assert (refused["detail"]["value"], refused["detail"]["bound"]) == ("0.10", "at least 0.60")
    assert client.get("/api/v1/audit/verify").json()["is_intact"]


def test_what_is_reported_at_the_very_end_is_written_before_the_session_closes(client, session_id, running):
    running.notices.put(SWAPPED)
    running.end()
    eventually(lambda: detail_of(client, session_id)["status"] == "ended")
    actions = [row["action"] for row in audit_rows(client)]
    assert actions.index("model.swapped") < actions.index("session.close")


# -- its quality, as maps -------------------------------------------------------------------------------------------


def test_the_maps_are_heights_above_the_mean_surface_with_null_where_nothing_was_measured(client, session_id, running):
    plain = make_model(1)
    raw = plain.mean_mm[::4, ::4] - np.float32(3.0)
    raw[87, 49] = np.nan
    residual = np.full((88, 50), 0.456, dtype=np.float32)
    running.model = replace(
        plain,
        sample_raw_mm=raw,
        sample_reconstructed_mm=plain.mean_mm[::4, ::4] - np.float32(2.5),
        residual_map_mm=residual,
    )
    url = f"/api/v1/sessions/{session_id}/models"
    eventually(lambda: len(client.get(url).json()["items"]) == 1)
    (model,) = client.get(url).json()["items"]
    maps = client.get(f"/api/v1/models/{model['id']}/quality-maps").json()
    assert maps.pop("model_id") == model["id"]
    assert {(len(one), len(one[0])) for one in maps.values()} == {(88, 50)}
    assert (maps["measured_mm"][0][0], maps["measured_mm"][87][49]) == (3.0, None)
    assert {value for row in maps["reconstructed_mm"] for value in row} == {2.5}
    assert {value for row in maps["residual_mm"] for value in row} == {0.46}


def test_a_model_of_an_earlier_version_has_no_maps(client, kept_model):
    maps = client.get(f"/api/v1/models/{kept_model['id']}/quality-maps").json()
    assert maps == {"model_id": kept_model["id"], "measured_mm": None, "reconstructed_mm": None, "residual_mm": None}


def test_maps_of_a_damaged_or_missing_file_are_refused(client, kept_model, settings):
    path = settings.data_dir / "models" / f"{kept_model['sha256']}.npz"
    for spoil in (lambda: path.write_bytes(b"none"), path.unlink):
        spoil()
        answer = client.get(f"/api/v1/models/{kept_model['id']}/quality-maps")
        assert (answer.status_code, answer.json()["code"]) == (409, "model_invalid")
    assert client.get(f"/api/v1/models/{'0' * 32}/quality-maps").status_code == 404


# -- how alike two models are ---------------------------------------------------------------------------------------


def test_a_model_explains_all_of_itself_and_what_its_components_share_with_another(client, session_id, running):
    url = f"/api/v1/sessions/{session_id}/models"
    # Four directions; the first component of the other model lies halfway between the first and the fourth.
    directions = np.linalg.qr(np.random.default_rng(3).normal(size=(70_000, 4)))[0].T.reshape(4, 350, 200)
    first = replace(make_model(1), components=directions[:3].astype(np.float32))
    turned = directions[:3].copy()
    turned[0] = (directions[0] + directions[3]) / np.sqrt(2.0)
    other = replace(first, components=turned.astype(np.float32), mean_mm=first.mean_mm + np.float32(5.0))
    for number, model in enumerate((first, other), start=1):
        running.model = model
        eventually(lambda number=number: len(client.get(url).json()["items"]) == number)
    newer, older = (one["id"] for one in client.get(url).json()["items"])
    same = client.get(f"/api/v1/models/{older}/similarity?other={older}").json()
    assert (same["explained_share"], same["shift_mm"], same["shape_mm"]) == (1.0, 0.0, 0.0)
    assert same["first_angle_deg"] == pytest.approx(0.0, abs=0.1)
    found = client.get(f"/api/v1/models/{older}/similarity?other={newer}").json()
    variance = first.eigenvalues_mm2[: len(first.components)]
    share = (variance.sum() - 0.5 * variance[0]) / variance.sum()
    assert found["explained_share"] == pytest.approx(share, abs=1e-3)
    assert found["first_angle_deg"] == pytest.approx(45.0, abs=0.1)
    assert (found["shift_mm"], found["shape_mm"]) == (-5.0, 0.0)


def test_models_of_two_patients_are_not_compared(client, calibration_id, kept_model, engine):
    other = client.post(
        "/api/v1/sessions", json={**make_session_body(calibration_id), "patient_reference": "P-0002"}
    ).json()["id"]
    act(client, other, "start")
    engine.running.model = make_model(2)
    url = f"/api/v1/sessions/{other}/models"
    eventually(lambda: len(client.get(url).json()["items"]) == 1)
    (model,) = client.get(url).json()["items"]
    answer = client.get(f"/api/v1/models/{model['id']}/similarity?other={kept_model['id']}")
    assert (answer.status_code, answer.json()["field"]) == (422, "other")


# -- what made a model ----------------------------------------------------------------------------------------------


def test_a_model_is_kept_with_what_made_it(client, kept_model, settings, calibration_id):
    model = load_model(settings.data_dir / "models" / f"{kept_model['sha256']}.npz")
    origin = model.provenance.origin
    assert (origin.patient, origin.source) == ("P-0001", "chest.oni")
    assert origin.created_at.endswith("Z")
    assert origin.software.startswith("tidegate ")
    assert (kept_model["patient_reference"], kept_model["calibration_id"]) == ("P-0001", calibration_id)
    assert (kept_model["source"], kept_model["cycles"], kept_model["training_frames"]) == ("chest.oni", 4, 100)


# -- a later fraction -------------------------------------------------------------------------------------------------


def test_a_later_session_begins_with_a_model_of_the_same_patient(client, kept_model, calibration_id, engine):
    answer = created(client, calibration_id, kept_model["id"], fraction_id="FX-4", fraction_number=4)
    assert (answer.status_code, answer.json()["model_id"]) == (201, kept_model["id"])
    assert act(client, answer.json()["id"], "start").status_code == 200
    plan = engine.running.plan
    assert plan.model.provenance.origin.patient == "P-0001"
    (started,) = audit_rows(client, "session.start")[-1:]
    assert started["detail"]["model_id"] == kept_model["id"]
    assert "a person has to set it" in started["detail"]["reference"]


def test_a_model_taken_over_by_a_later_session_is_the_same_file_under_that_session_too(
    client, kept_model, calibration_id, engine, settings
):
    session_id = created(client, calibration_id, kept_model["id"]).json()["id"]
    act(client, session_id, "start")
    engine.running.model = engine.running.plan.model
    url = f"/api/v1/sessions/{session_id}/models"
    eventually(lambda: len(client.get(url).json()["items"]) == 1)
    assert client.get(url).json()["items"][0]["sha256"] == kept_model["sha256"]
    assert len(list((settings.data_dir / "models").iterdir())) == 1


def test_a_model_of_another_patient_is_refused_without_telling_whose_it_is(client, kept_model, calibration_id):
    answer = created(client, calibration_id, kept_model["id"], patient_reference="P-0002")
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["field"]) == (409, "model_mismatch", "model_id")
    assert (problem["value"], problem["bound"]) == (kept_model["id"], "a model of P-0002")
    assert "P-0001" not in answer.text
    assert audit_rows(client, "session.create")[-1]["outcome"] == "refused"


def test_a_model_of_another_calibration_is_refused(client, kept_model, calibration_text, calibration_id):
    other_id = upload(client, edited(calibration_text, "depth.fx", 571.0)).json()["id"]
    problem = created(client, other_id, kept_model["id"]).json()
    assert (problem["status"], problem["code"], problem["field"]) == (409, "model_mismatch", "model_id")
    assert other_id in problem["bound"]
    assert calibration_id in problem["detail"]


def test_an_unknown_or_malformed_model_is_refused_by_name(client, calibration_id):
    unknown = created(client, calibration_id, "0" * 32)
    assert (unknown.status_code, unknown.json()["field"]) == (404, "model_id")
    malformed = created(client, calibration_id, "../models/x")
    assert (malformed.status_code, malformed.json()["field"]) == (422, "model_id")


def name_another_file(settings, model_id, sha256):
    """Change the table as only its owner can: the trigger that refuses it goes first."""
    database = Database(settings.database_place)
    with database.connect() as connection, connection.begin():
        connection.execute(text("DROP TRIGGER models_no_update" + (" ON models" if database.is_postgresql else "")))
        changes = {"sha256": sha256, "id": model_id}
        connection.execute(text("UPDATE models SET sha256 = :sha256 WHERE id = :id"), changes)
    database.close()


@pytest.mark.parametrize("spoiled", ["patient", "gone", "changed"])
def test_a_model_whose_file_is_not_what_the_table_states_does_not_start_a_session(
    client, kept_model, calibration_id, settings, engine, spoiled
):
    session_id = created(client, calibration_id, kept_model["id"]).json()["id"]
    path = settings.data_dir / "models" / f"{kept_model['sha256']}.npz"
    if spoiled == "gone":
        path.unlink()
    elif spoiled == "changed":
        save_model(make_model(2), path)
    else:  # a file that is whole and in its place, of another patient: the table was changed
        other = make_model(3).from_origin(ModelOrigin(patient="P-0666"))
        sha256 = ModelStore(settings.data_dir / "models").save(other)
        name_another_file(settings, kept_model["id"], sha256)
    opened = len(engine.opened)
    answer = act(client, session_id, "start")
    assert answer.status_code == 409
    assert answer.json()["code"] == ("model_mismatch" if spoiled == "patient" else "model_invalid")
    assert detail_of(client, session_id)["status"] == "created"
    assert len(engine.opened) == opened


def test_the_session_reports_how_far_the_patient_is_from_the_model_and_whether_there_is_a_reference(
    client, session_id, running
):
    running.frame()
    detail = detail_of(client, session_id)
    assert (detail["likeness"], detail["has_reference"]) == (None, True)
    running.has_reference = False
    running.likeness = PatientMatch(
        frames=60,
        explained_share=1.0,
        residual_mm=0.91,
        shift_mm=(1.0, -2.0, 35.0),
        tilt_deg=0.4,
        shape_mm=0.6,
        refusal=ModelMismatchError("model.shift_mm", "35.1", "at most 20", "learn a new model"),
    )
    detail = detail_of(client, session_id)
    assert not detail["has_reference"]
    assert detail["likeness"]["shift_mm"] == [1.0, -2.0, 35.0]
    assert not detail["likeness"]["is_accepted"]
    assert "must be at most 20" in detail["likeness"]["refusal"]
    act(client, session_id, "stop")
    assert detail_of(client, session_id)["likeness"] is None


def sites(prefix, bounds):
    return sorted(name for name in bounds if f"{prefix}{name}" in Settings.model_fields)


# -- a site's settings ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sites("training_", TRAINING_BOUNDS))
def test_every_bound_of_the_training_can_be_set_by_a_site_and_reaches_the_engine(name):
    low, high = TRAINING_BOUNDS[name]
    high = 200 if name == "min_frames" else high
    value = type(getattr(TrainingSettings(), name))((low + high) / 2)
    others = {"min_seconds": {"training_max_seconds": 600.0}}
    settings = Settings(**{f"training_{name}": value, **others.get(name, {})})
    assert getattr(LocalEngine(settings)._measuring.training, name) == value
    assert Settings().training == TrainingSettings()


@pytest.mark.parametrize("name", sites("likeness_", PATIENT_MATCH_BOUNDS))
def test_every_bound_of_the_likeness_can_be_set_by_a_site_and_reaches_the_engine(name):
    low, high = PATIENT_MATCH_BOUNDS[name]
    settings = Settings(**{f"likeness_{name}": (low + high) / 2})
    assert getattr(LocalEngine(settings)._measuring.likeness, name) == (low + high) / 2
    assert Settings().likeness == PatientMatchLimits()
    with pytest.raises(InvalidValueError, match=name):
        PatientMatchLimits(**{name: 2.0 * high + 1.0})


def test_the_interval_is_given_in_minutes_and_off_by_default():
    assert Settings().training.retrain_interval_s == 0.0
    assert Settings(retrain_interval_min=5.0).training.retrain_interval_s == 300.0


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"training_min_seconds": 50.0}, "training_max_seconds must be at least min_seconds"),
        ({"training_min_frames": 300}, "training.min_frames: Input should be less than or equal to 225"),
        ({"retrain_interval_min": 0.05}, "retrain_interval_min must be 0, or at least 10"),
    ],
    ids=str,
)
def test_settings_that_cannot_be_met_together_are_refused_at_the_start(monkeypatch, tmp_path, settings, said):
    give_settings(monkeypatch, tmp_path, **settings)
    with pytest.raises(SettingsError, match=said):
        load_settings()
