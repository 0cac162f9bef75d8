"""A real process: killed for real, stopped for real, watched over a real socket."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from service.storage import audit
from service.storage.database.engine import Database
from service.storage.samples.store import SampleStore
from tests.support.service.api_calls import act, make_calibration, make_session_body, upload
from tests.support.service.processes import free_port, service_process
from tests.support.waiting import eventually

pytestmark = [pytest.mark.waiting, pytest.mark.long]

SAMPLES_MAY_LOSE_NS = 1_000_000_000
A_MOMENT_NS = 500_000_000
"""The writer takes a transition within 20 ms; the rest is for a busy machine's disk and scheduler."""


@pytest.fixture
def self_driving(tmp_path):
    (tmp_path / "chest.oni").write_bytes(b"")
    port = free_port()
    arguments = ("tests.support.service.self_driving_program", str(tmp_path / "data"), str(tmp_path), str(port))
    started = service_process(*arguments, port=port, log=tmp_path / "log", data=tmp_path / "data")
    with started as (process, client):
        calibration_id = upload(client, make_calibration().to_json()).json()["id"]
        session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
        assert act(client, session_id, "start").status_code == 200
        yield process, client, session_id, tmp_path


def live_stream(client):
    return connect(f"ws://127.0.0.1:{client.base_url.port}/api/v1/live", additional_headers=client.key_headers)


def lines(folder, kind):
    found = [line.split() for line in (folder / "log").read_text().splitlines()]
    return [(int(line[1]), int(line[-1])) for line in found if len(line) == 3 and line[0] == kind]


def test_a_killed_service_loses_no_transition_and_at_most_the_last_second_of_samples(self_driving):
    process, _, session_id, folder = self_driving
    eventually(lambda: len(lines(folder, "sample")) >= 60, within_s=20.0)
    process.send_signal(signal.SIGKILL)
    process.wait()
    killed_ns = time.monotonic_ns()
    database = Database(folder / "data" / "tidegate.db")
    with database.read() as db:
        assert audit.verify(db).first_broken_sequence is None
    database.close()
    raw = sqlite3.connect(folder / "data" / "tidegate.db")
    batches = SampleStore(folder / "data" / "samples").batches(session_id)
    samples = [index for batch in batches for index in batch["frame_index"].to_pylist()]
    (transitions,) = raw.execute("SELECT count(*) FROM audit WHERE action = 'gate.transition'").fetchone()
    raw.close()
    due = [index for index, at_ns in lines(folder, "sample") if at_ns < killed_ns - SAMPLES_MAY_LOSE_NS]
    assert len(due) > 20
    assert samples == list(range(len(samples)))
    assert len(samples) >= len(due)
    happened = [index for index, at_ns in lines(folder, "transition") if at_ns < killed_ns - A_MOMENT_NS]
    assert len(happened) >= 4
    assert transitions >= len(happened)


def test_after_a_kill_the_service_starts_again_and_states_the_session_was_interrupted(self_driving):
    process, _, session_id, folder = self_driving
    eventually(lambda: len(lines(folder, "sample")) >= 15, within_s=20.0)
    process.send_signal(signal.SIGKILL)
    process.wait()
    port = free_port()
    arguments = ("tests.support.service.self_driving_program", str(folder / "data"), str(folder), str(port))
    with service_process(*arguments, port=port, log=folder / "second log", data=folder / "data") as (_, client):
        assert client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "interrupted"
        assert client.get("/api/v1/audit/verify").json()["is_intact"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=str)
def test_on_a_stop_signal_it_holds_first_although_a_client_stays_then_closes_the_session(self_driving, number):
    process, client, session_id, folder = self_driving
    assert "P-0001" in client.get(f"/api/v1/sessions/{session_id}").text
    with live_stream(client) as socket:
        eventually(lambda: json.loads(socket.recv())["type"] == "sample", within_s=20.0)
        process.send_signal(number)
        with pytest.raises(ConnectionClosed):
            _read_to_the_end(socket)
        closed_ns = time.monotonic_ns()
        assert process.wait(20.0) == 0
    ((_, stopped_ns),) = lines(folder, "stopped")
    assert stopped_ns < closed_ns
    raw = sqlite3.connect(folder / "data" / "tidegate.db")
    rows = [row for (row,) in raw.execute("SELECT action FROM audit ORDER BY sequence")]
    (status,) = raw.execute("SELECT status FROM sessions").fetchone()
    raw.close()
    assert rows[-3:] == ["gate.transition", "session.close", "service.stop"]
    assert status == "stopped"
    assert "P-0001" not in (folder / "log").read_text(), "nothing about patients is logged"


def _read_to_the_end(socket):
    while True:
        socket.recv(timeout=20.0)


def test_the_live_stream_over_a_real_socket_comes_at_the_engine_s_rate(self_driving):
    _, client, session_id, _ = self_driving
    with live_stream(client) as socket:
        assert json.loads(socket.recv())["type"] == "hello"
        samples = [json.loads(socket.recv(timeout=10.0)) for _ in range(15)]
    assert {sample["type"] for sample in samples} == {"sample"}
    assert [sample["sequence"] for sample in samples] == list(range(15))
    frames = [sample["frame_index"] for sample in samples]
    assert frames == sorted(set(frames))
    assert {sample["session_id"] for sample in samples} == {session_id}


def test_the_command_states_in_one_line_that_its_port_is_taken_and_ends_with_0_on_a_stop_signal(tmp_path):
    """On SIGINT; on SIGTERM, as every system sends it, in test_tls_and_first_admin.py too."""
    port = free_port()
    arguments = ("service.cli", "serve", "--port", str(port), "--data", str(tmp_path / "data"))
    with service_process(*arguments, port=port, log=tmp_path / "log") as (process, client):
        assert client.get("/").status_code == 200
        done = subprocess.run(
            [sys.executable, "-m", *arguments], capture_output=True, text=True, timeout=60, env=os.environ, check=False
        )
        process.send_signal(signal.SIGINT)
        assert process.wait(20.0) == 0
    log = (tmp_path / "log").read_text()
    assert "SIMULATED" in log
    assert "Traceback" not in log
    assert done.returncode == 2
    started, *refusal = done.stderr.strip().splitlines()
    assert started.startswith("Tidegate ")
    assert len(refusal) == 1
    assert str(port) in refusal[0]
