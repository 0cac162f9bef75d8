"""Databases, backups, models and journals that an earlier version wrote are upgraded, restored, read and recovered."""

import csv
import json
import sqlite3
import zipfile
from contextlib import closing

import pytest
from typer.testing import CliRunner

from engine.calibration.camera_calibration import parse_calibration
from engine.control.journal.format import read_journal
from engine.core.gate_state import GateState
from engine.motion.learning.model_file import load_model
from service.cli import app
from service.core.settings.database_place import DATABASE_NAME
from service.core.settings.settings import Settings
from service.storage.files.motion_models import ModelStore
from service.web.app import create_app
from tests.support import earlier_files
from tests.support.database.backups import rows_at
from tests.support.earlier_files import KILLED, LEARNING, RESUMED
from tests.support.service.accounts import PeopleClient

FRAMES = {LEARNING: 281, RESUMED: 238}
TRANSITIONS = {LEARNING: 21, RESUMED: 33}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return earlier_files.unpacked("folders.tar.xz", tmp_path_factory.mktemp("folders"))


@pytest.fixture
def data(folders, tmp_path):
    return earlier_files.copied(folders, "data", tmp_path)


@pytest.fixture
def killed(folders, tmp_path):
    return earlier_files.copied(folders, "killed/data", tmp_path)


@pytest.fixture
def run():
    def run(*words):
        return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})

    return run


def service_on(data):
    """A service on a data folder; its journals lie beside it."""
    return PeopleClient(
        create_app(Settings(data_dir=data, journal_dir=data.parent / "journals", allowed_hosts=("testserver",)))
    )


def asked(client, path, **params):
    """GET what the API gives."""
    answer = client.get(f"/api/v1/{path}", params=params)
    assert answer.status_code == 200, answer.text
    return answer.json()


def written_rows(data, query):
    """Read rows as they were written, without any of our own code."""
    with closing(sqlite3.connect(data / DATABASE_NAME)) as connection:
        connection.row_factory = sqlite3.Row
        return [dict(row) for row in connection.execute(query)]


def test_a_service_opens_an_earlier_data_folder_and_all_of_it_can_be_read(data):
    audit = written_rows(data, "SELECT sequence, actor, action, outcome, session_id, hash FROM audit")
    sessions = {row["id"]: row for row in written_rows(data, "SELECT * FROM sessions")}
    with service_on(data) as client:
        listed = asked(client, "sessions")["items"]
        assert {one["id"] for one in listed} == set(sessions) == {LEARNING, RESUMED}
        for session_id, row in sessions.items():
            detail = asked(client, f"sessions/{session_id}")
            assert {name: detail[name] for name in ("status", "operator")} == {
                name: row[name] for name in ("status", "operator")
            }
            assert detail["summary"]["frames"] == FRAMES[session_id]
            samples = client.get(f"/api/v1/sessions/{session_id}/samples", params={"format": "csv"}).text
            frames = [int(row["frame_index"]) for row in csv.DictReader(samples.splitlines())]
            assert (len(frames), frames) == (FRAMES[session_id], sorted(frames))
            transitions = asked(client, f"sessions/{session_id}/transitions", limit=500)["items"]
            assert len(transitions) == TRANSITIONS[session_id]
        assert [one["id"] for one in asked(client, f"sessions/{LEARNING}/models")["items"]]
        assert asked(client, "calibrations")["items"]
        assert [plan["label"] for plan in asked(client, "plans")["items"]] == ["LUNG_DIBH"]
        assert [key["name"] for key in asked(client, "keys")["items"]] == ["planning"]
        assert "B. Physicist" in {user["name"] for user in asked(client, "users")["items"]}
        (qa_run,) = asked(client, "qa/runs")["items"]
        assert (qa_run["verdict"], qa_run["is_simulated"]) == ("pass", True)
        read = asked(client, "audit", limit=500)["items"]
        for row, now in zip(audit, reversed(read[-len(audit) :]), strict=True):
            assert {name: now[name] for name in row} == row
        assert asked(client, "audit/verify")["is_intact"]


def test_an_earlier_database_is_brought_to_the_newest_tables_and_keeps_every_row(data, run):
    before = rows_at(data / DATABASE_NAME)
    answer = run("database", "upgrade", "--data", data)
    assert answer.exit_code == 0, answer.output
    assert "to come" not in run("database", "status", "--data", data).output
    after = rows_at(data / DATABASE_NAME)
    for table, rows in before.items():
        kept = [{name: row[name] for name in old if name in row} for old, row in zip(rows, after[table], strict=False)]
        assert kept == rows, table
    answer = run("audit", "verify", "--data", data)
    assert (answer.exit_code, "intact" in answer.output) == (0, True), answer.output


@pytest.mark.both_databases
def test_an_earlier_backup_is_restored_and_its_audit_holds(folders, empty_place, tmp_path, run, monkeypatch):
    if not hasattr(empty_place, "drivername"):
        place, data = tmp_path / "new" / DATABASE_NAME, tmp_path / "new"
    else:
        place, data = empty_place, tmp_path / "new"
        monkeypatch.setenv("TIDEGATE_DATABASE_URL", empty_place.render_as_string(hide_password=False))
    answer = run("restore", folders / "all.backup", "--data", data)
    assert answer.exit_code == 0, answer.output
    restored = rows_at(place)
    with zipfile.ZipFile(folders / "all.backup") as backup:
        tables = {name: backup.read(name).splitlines() for name in backup.namelist() if name.startswith("tables/")}
        files = [one for one in backup.namelist() if one.startswith(("models/", "samples/", "replays/"))]
        assert {name: (data / name).read_bytes() for name in files} == {name: backup.read(name) for name in files}
    counts = {name.removeprefix("tables/").removesuffix(".jsonl"): len(rows) for name, rows in tables.items()}
    counts["audit"] += 1  # the restore's own
    assert {name: len(restored[name]) for name in counts} == counts
    assert {row["id"] for row in restored["sessions"]} == {LEARNING, RESUMED}
    assert len(files) == 7
    answer = run("audit", "verify", "--data", data)
    assert (answer.exit_code, "intact" in answer.output) == (0, True), answer.output


def test_earlier_models_are_read_and_are_what_was_kept(folders):
    store = ModelStore(folders / "data" / "models")
    paths = sorted((folders / "data" / "models").glob("*.npz"))
    assert len(paths) == 3
    for path in paths:
        model = store.load(path.stem)  # refuses a model whose content has another hash
        assert model.components.shape == (1, 350, 200)
        assert model.training_frames == load_model(path).training_frames >= 24


def test_an_earlier_calibration_is_read_and_is_the_one_that_the_database_keeps(folders, tmp_path):
    path = earlier_files.unpacked("recording.tar.xz", tmp_path) / "calibration.json"
    document = json.loads(path.read_text())
    calibration = parse_calibration(path.read_bytes())
    assert document["schema"] == "tidegate.calibration/1"
    assert (calibration.camera, calibration.depth.fx) == (document["camera"], document["depth"]["fx"])
    kept = {row["document"] for row in written_rows(folders / "data", "SELECT document FROM calibrations")}
    assert {parse_calibration(text.encode()).to_json() for text in kept} == {calibration.to_json()}


def test_an_earlier_journal_of_a_killed_process_is_recovered_into_the_audit(killed):
    (journal,) = (killed.parent / "journals").glob("*.journal")
    kept = [entry.transition for entry in read_journal(journal.read_bytes()).entries]
    query = f"SELECT detail FROM audit WHERE action = 'gate.transition' AND session_id = '{KILLED}'"
    audited = [json.loads(row["detail"]) for row in written_rows(killed, query)]
    assert kept[-1].to_state is GateState.BEAM_ON
    assert len(audited) < len(kept), "the process was killed before the audit had all"
    with service_on(killed) as client:
        assert asked(client, f"sessions/{KILLED}")["status"] not in {"running", "created"}
        newest = asked(client, "audit", limit=500)["items"]
        assert asked(client, "audit/verify")["is_intact"]
    rows = [
        row["detail"] for row in reversed(newest) if row["session_id"] == KILLED and row["action"] == "gate.transition"
    ]
    assert [row["number"] for row in rows][: len(kept)] == [transition.number for transition in kept]
    assert [row.get("recovered", False) for row in rows].count(True) == len(kept) - len(audited)
    (account,) = [row["detail"] for row in newest if row["action"] == "journal.recovered"]
    assert (account["last_state"], account["damaged_slots"]) == ("beam_on", [])
    assert not journal.exists()
