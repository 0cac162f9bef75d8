"""What is removed, what never is, and who is let in when there is no room."""

import hashlib
import json
import shutil
from datetime import timedelta
from types import SimpleNamespace

import pytest
from sqlalchemy import select

from service.core.settings.settings import Settings
from service.storage.audit import AuditRow
from service.storage.believed_time import BelievedTime
from service.storage.files.cleanup import (
    AGAIN_S,
    EVERY_S,
    CleanupWorker,
    ended_sessions,
    folder_bytes,
    holdings,
    remove_old,
    session_bytes,
)
from tests.support.samples.sessions import BEGUN, add_session

OLD, NEW, OPEN, STRAY = ("0" * 32, "1" * 32, "2" * 32, "3" * 32)
NOW = BEGUN + timedelta(days=31)


@pytest.fixture
def data_dir(tmp_path, database):
    """An old session, one of yesterday, one that runs, and files of which no one knows a session."""
    folder = tmp_path / "data"
    add_session(database, OLD, status="ended", ended_at=BEGUN)
    add_session(database, NEW, status="stopped", ended_at=NOW - timedelta(days=1))
    add_session(database, OPEN, ended_at=BEGUN)  # a row that contradicts itself: what it says of running counts
    for session_id in (OLD, NEW, OPEN, STRAY):
        for place in ("samples/{}.parquet", "raw/{}.oni", "replays/{}.tape"):
            path = folder / place.format(session_id)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(f"{place} {session_id}".encode())
    return folder


def left(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def removals(database):
    with database.read() as db:
        rows = db.scalars(select(AuditRow).where(AuditRow.action.like("%.removed")).order_by(AuditRow.sequence))
        return [(row.action, row.session_id, json.loads(row.detail)) for row in rows]


def site(folder, **given):
    return Settings(data_dir=folder, **given)


def test_a_site_that_sets_nothing_keeps_everything(database, data_dir):
    before = left(data_dir)
    assert remove_old(database, data_dir, site(data_dir), NOW + timedelta(days=36_500)) == []
    assert left(data_dir) == before


@pytest.mark.both_databases
def test_what_is_older_goes_and_the_audit_states_what_and_by_which_rule(database, data_dir):
    gone = data_dir / "samples" / f"{OLD}.parquet"
    sha256, size = hashlib.sha256(gone.read_bytes()).hexdigest(), gone.stat().st_size
    before = left(data_dir)
    remove_old(database, data_dir, site(data_dir, retain_samples_days=30), NOW)
    assert before - left(data_dir) == {f"samples/{OLD}.parquet", f"replays/{OLD}.tape"}
    reported = {action: (session_id, detail) for action, session_id, detail in removals(database)}
    assert reported.keys() == {"samples.removed", "tape.removed"}
    session_id, detail = reported["samples.removed"]
    assert (session_id, detail["file"], detail["sha256"], detail["bytes"]) == (OLD, gone.name, sha256, size)
    assert detail["rule"] == "retain_samples_days is 30"
    assert remove_old(database, data_dir, site(data_dir, retain_samples_days=30), NOW) == []


@pytest.mark.parametrize(("days", "is_gone"), [(31, False), (30, True)])
def test_a_day_is_a_day(database, data_dir, days, is_gone):
    remove_old(database, data_dir, site(data_dir, retain_raw_days=days), NOW)
    assert (f"raw/{OLD}.oni" not in left(data_dir)) is is_gone
    assert f"samples/{OLD}.parquet" in left(data_dir)


def test_an_open_session_s_files_and_foreign_files_stay_however_old(database, data_dir):
    settings = site(data_dir, retain_samples_days=1, retain_raw_days=1)
    remove_old(database, data_dir, settings, NOW + timedelta(days=9999))
    assert {path.split("/")[1][0] for path in left(data_dir) if not path.endswith(".db")} == {"2", "3"}


def test_the_oldest_goes_first(database, data_dir):
    found = holdings(data_dir, ended_sessions(database))
    assert [one.session_id for one in found] == [OLD] * 3 + [NEW] * 3


def test_a_removal_that_cannot_be_written_down_does_not_happen(database, data_dir, monkeypatch):
    def fails(*_arguments):
        raise RuntimeError

    monkeypatch.setattr("service.storage.files.cleanup.audit.append", fails)
    with pytest.raises(RuntimeError):
        remove_old(database, data_dir, site(data_dir, retain_samples_days=30), NOW)
    assert f"samples/{OLD}.parquet" in left(data_dir)


def test_the_caretaker_waits_for_a_session_and_looks_every_hour(database, data_dir):
    is_busy = [True]
    settings = site(data_dir, retain_samples_days=30)
    caretaker = CleanupWorker(
        database, settings, is_busy=lambda: is_busy[0], time=BelievedTime(database, now=lambda: NOW)
    )
    assert caretaker._turn() == AGAIN_S
    assert removals(database) == []
    is_busy[0] = False
    assert caretaker._turn() == EVERY_S
    assert len(removals(database)) == 2


def test_a_caretaker_that_cannot_remove_tries_again(database, data_dir, monkeypatch, caplog):
    def fails(*_arguments):
        raise OSError(5, "no")

    monkeypatch.setattr("service.storage.files.cleanup.remove_old", fails)
    caretaker = CleanupWorker(database, site(data_dir), is_busy=lambda: False)
    assert caretaker._turn() == AGAIN_S
    assert "could not be removed" in caplog.text
    caretaker.start()
    caretaker.close()
    assert not caretaker.has_ended


def test_a_session_takes_what_its_length_takes(tmp_path):
    assert session_bytes(site(tmp_path, session_room_min=10.0)) == 10 * 60 * 30 * 1700


def test_without_room_on_the_disk_no_session_begins_and_the_problem_states_how_much(client, session_body, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=250 * 2**20))
    answer = client.post("/api/v1/sessions", json=session_body)
    assert (answer.status_code, answer.json()["code"], answer.json()["field"]) == (507, "storage_low", "disk")
    assert answer.json()["value"] == "'50 MiB'"
    assert "at least 88 MiB beyond the 200 MiB" in answer.json()["bound"]
    rows = client.get("/api/v1/audit").json()["items"]
    assert (rows[0]["action"], rows[0]["outcome"], rows[0]["detail"]["code"]) == (
        *("session.create", "refused"),
        "storage_low",
    )


def test_a_quota_that_is_full_lets_no_session_begin(client, session_body, settings, monkeypatch):
    monkeypatch.setattr("service.storage.files.cleanup.folder_bytes", lambda _folder: 2**30)
    assert client.post("/api/v1/sessions", json=session_body).status_code == 201
    object.__setattr__(settings, "data_quota_gb", 1.05)
    for path in ("stop",):
        client.post(f"/api/v1/sessions/{_newest(client)}/{path}", json={"operator": "A. Therapist"})
    answer = client.post("/api/v1/sessions", json=session_body)
    assert (answer.status_code, answer.json()["field"]) == (507, "data_quota_gb")


def _newest(client):
    return client.get("/api/v1/sessions").json()["items"][0]["id"]


def test_removable_files_are_removed_before_a_session_is_refused(settings, tmp_path, monkeypatch):
    from service.storage.files.cleanup import refuse_without_room

    free = [0]
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=free[0]))
    refuse_without_room(settings, lambda: free.__setitem__(0, 2**40))
    asked = []
    refuse_without_room(settings, lambda: asked.append(True))
    assert asked == [], "with room nothing is touched"


def test_a_folder_s_size_is_that_of_its_files(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").write_bytes(bytes(1000))
    (tmp_path / "c").write_bytes(bytes(24))
    (tmp_path / "gone").symlink_to(tmp_path / "nowhere")
    assert folder_bytes(tmp_path) - (tmp_path / "gone").lstat().st_size == 1024
