"""The writer thread: what it does when the database, the disk or it itself fails."""

import os
import queue
import shutil
import sqlite3
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from engine.control.outputs import LoopStatus
from engine.core.gate_state import GateState, HoldReason
from service.sessions.lifecycle import writer
from service.storage.samples import layout
from service.storage.samples.store import SampleStore
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows, make_session_body, upload
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow


def stored_rows(settings, session_id):
    """Every sample on file, as columns."""
    batches = SampleStore(settings.data_dir / "samples").batches(session_id)
    return [row for batch in batches for row in batch.to_pylist()]


def stored_samples(settings, session_id):
    return [row["frame_index"] for row in stored_rows(settings, session_id)]


@pytest.fixture
def locker(settings, running):
    """Another process's hand on the database."""
    connection = sqlite3.connect(settings.data_dir / "tidegate.db", isolation_level=None)
    yield connection
    connection.close()


def test_a_locked_database_faults_the_gate_and_loses_nothing(client, session_id, running, settings, locker):
    locker.execute("BEGIN IMMEDIATE")
    running.transition(GateState.HOLD, HoldReason.DWELL)
    for _ in range(5):
        running.frame()
    eventually(lambda: HoldReason.AUDIT_BEHIND in running.faults)
    for _ in range(5):
        running.frame()
    locker.execute("ROLLBACK")
    eventually(lambda: stored_samples(settings, session_id) == list(range(10)))
    assert len(audit_rows(client, "gate.transition")) == 1


def test_a_locked_database_faults_the_gate_though_there_is_nothing_to_write(running, locker):
    """Samples have a file of their own: a beam that is simply on writes no row for as long as a breath is held."""
    locker.execute("BEGIN IMMEDIATE")
    eventually(lambda: HoldReason.AUDIT_BEHIND in running.faults)
    locker.execute("ROLLBACK")


def test_while_the_database_is_locked_the_queues_fill_so_that_the_gate_holds_by_itself(running, locker):
    locker.execute("BEGIN IMMEDIATE")
    running.transition(GateState.HOLD, HoldReason.DWELL)
    eventually(lambda: running.faults)
    with pytest.raises(queue.Full):
        [running.frame() for _ in range(2000)]
    locker.execute("ROLLBACK")


def test_nothing_that_could_lead_to_a_permit_is_asked_when_it_cannot_be_written_down(
    client, session_id, running, locker, monkeypatch
):
    locker.execute("BEGIN IMMEDIATE")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.storage.database.engine.Session.begin", _refuse_to_begin)
        answer = act(client, session_id, "arm")
        disarmed = act(client, session_id, "disarm")
    locker.execute("ROLLBACK")
    assert (answer.status_code, answer.json()["code"]) == (503, "storage_unavailable")
    assert disarmed.status_code == 503
    assert [type(command).__name__ for command in running.commands] == ["Disarm"]


def _refuse_to_begin(_session):
    raise sqlite_error()


def sqlite_error():
    from sqlalchemy.exc import OperationalError

    return OperationalError("BEGIN IMMEDIATE", {}, sqlite3.OperationalError("database is locked"))


def test_a_disk_that_is_almost_full_faults_the_gate(client, session_id, engine, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=1024))
    act(client, session_id, "start")
    eventually(lambda: HoldReason.DISK_LOW in engine.running.faults)
    assert client.get("/readyz").status_code == 503
    assert "disk" in client.get("/readyz").json()["not_ready"][0]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_writer_that_breaks_stops_the_engine_and_closes_the_session(client, session_id, running, monkeypatch):
    def broken(_record):
        msg = "a bug"
        raise RuntimeError(msg)

    monkeypatch.setattr(layout, "sample_values", broken)
    running.transition(GateState.HOLD, HoldReason.DWELL)
    running.frame()
    eventually(lambda: running.status.is_over)
    assert HoldReason.AUDIT_BEHIND in running.faults
    eventually(lambda: client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "failed")
    reasons = [row["detail"]["reason"] for row in audit_rows(client, "gate.transition")]
    assert reasons == ["dwell", "engine_stopped"]


def test_the_last_transition_before_the_end_is_written(client, session_id, running):
    running.transition(GateState.HOLD, HoldReason.DWELL)
    running.end()
    eventually(lambda: client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "ended")
    states = [row["detail"]["reason"] for row in audit_rows(client, "gate.transition")]
    assert states == ["dwell", "engine_stopped"]


def test_regions_are_stored_as_they_were_measured(client, session_id, running, settings):
    running.frame()
    running.frame(whole_mm=None)
    act(client, session_id, "stop")
    measured, lost = stored_rows(settings, session_id)
    regions = np.array(measured["regions_mm"]).reshape(measured["region_rows"], -1)
    assert regions.shape == (14, 8)
    assert np.isnan(regions[0, 0])
    assert (regions.ravel()[1:] == 1.5).all()
    assert (lost["region_rows"], lost["regions_mm"]) == (None, None)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_what_is_no_number_is_stored_as_unknown(client, session_id, running, settings, value):
    running.frame(whole_mm=value)
    act(client, session_id, "stop")
    (row,) = stored_rows(settings, session_id)
    assert (row["whole_mm"], row["signal_mm"], row["thorax_mm"]) == (None, None, 1.1)


def test_more_than_one_batch_that_waits_at_the_end_is_written_whole(client, session_id, running, settings, locker):
    locker.execute("BEGIN IMMEDIATE")
    running.transition(GateState.HOLD, HoldReason.DWELL)
    running.frame()
    eventually(lambda: running.faults)
    for _ in range(880):
        running.frame()
    running.end()
    locker.execute("ROLLBACK")
    eventually(lambda: client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "ended")
    assert stored_samples(settings, session_id) == list(range(881))


def test_a_session_a_killed_process_left_running_is_closed_at_the_next_start(settings, engine, calibration_text):

    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        calibration_id = upload(client, calibration_text).json()["id"]
        session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
    connection = sqlite3.connect(settings.data_dir / "tidegate.db")
    connection.execute("UPDATE sessions SET status = 'running'")
    connection.commit()
    connection.close()
    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        assert client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "interrupted"
        assert audit_rows(client, "session.close")[-1]["outcome"] == "failed"
        assert client.post("/api/v1/sessions", json=make_session_body(calibration_id)).status_code == 201


def test_a_hung_engine_counts_as_failed(client, session_id, running):
    running.run_state = LoopStatus.FAILED
    running.error = "the engine did not stop in time; the beam is held"
    eventually(lambda: client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "failed")


def test_a_service_that_ends_leaves_a_long_session_a_stream_and_the_next_start_settles_it(
    settings, engine, calibration_text, monkeypatch
):
    monkeypatch.setattr(writer, "MOST_HURRIED_ROWS", 3)
    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        session_id = _started(client, calibration_text)
        for _ in range(4):
            engine.running.frame()
    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        assert client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "stopped"
        (closed,) = audit_rows(client, "session.close")
        (settled,) = audit_rows(client, "samples.settled")
    assert closed["detail"]["samples"]["rows"] == settled["detail"]["rows"] == 4
    assert closed["detail"]["samples"]["stream_sha256"] == settled["detail"]["stream_sha256"]
    assert stored_samples(settings, session_id) == [0, 1, 2, 3]


def _started(client, calibration_text):
    calibration_id = upload(client, calibration_text).json()["id"]
    session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
    assert act(client, session_id, "start").status_code == 200
    return session_id


def test_a_disk_that_does_not_take_samples_faults_the_gate_and_loses_none(
    client, session_id, running, settings, monkeypatch
):
    def full(*_arguments):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        running.frame()
        eventually(lambda: HoldReason.RECORDER_BEHIND in running.faults)
        running.frame()
    eventually(lambda: stored_samples(settings, session_id) == [0, 1])


def test_a_write_that_takes_long_is_in_the_log(client, session_id, running, settings, monkeypatch, caplog):
    sync, never = os.fsync, threading.Event()

    def slow(file):
        never.wait(0.02)
        sync(file)

    monkeypatch.setattr(writer, "SLOW_S", 0.01)
    monkeypatch.setattr(os, "fsync", slow)
    running.frame()
    eventually(lambda: any(f"{session_id}: write_samples took" in line for line in caplog.messages))


def test_a_sample_file_that_was_taken_away_faults_the_gate(client, session_id, running, settings, monkeypatch):
    monkeypatch.setattr(writer, "DISK_CHECK_S", 0.01)
    (settings.data_dir / "samples" / f"{session_id}.arrows").rename(settings.data_dir / "away")
    eventually(lambda: HoldReason.RECORDER_BEHIND in running.faults)
    (settings.data_dir / "away").rename(settings.data_dir / "samples" / f"{session_id}.arrows")
    running.faults.clear()
    running.frame()
    act(client, session_id, "stop")
    assert stored_samples(settings, session_id) == [0]


def test_no_engine_is_started_where_no_sample_file_can_be(client, session_id, engine, settings):
    (settings.data_dir / "samples").write_bytes(b"a file where the folder should be")
    answer = act(client, session_id, "start")
    assert (answer.status_code, answer.json()["code"]) == (503, "storage_unwritable")
    assert engine.opened == []


def test_an_engine_that_does_not_open_leaves_no_sample_file(client, session_id, engine, settings):
    from engine.core.errors import SourceLostError

    engine.fail_with = SourceLostError("no camera")
    assert act(client, session_id, "start").status_code == 503
    assert list((settings.data_dir / "samples").iterdir()) == []
